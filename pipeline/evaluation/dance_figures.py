"""Figures of dances: beats, feet, genre and tempo of each motion, distances and variety of many (UDE 4.3).

Features of FID, Diversity and MultiModality are those of `dance_features` on the body's 22 joints, with the
first root at the origin and at the published 60 frames a second: motions of other rates are resampled
linearly **[ours]**, which leaves no acceleration within their own frames. SMPL's two hand joints, which
publications count as well, are missing here, so the figures compare within this program and not with papers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.synth.measure_dance import measure_dance
from motionloom.models.metrics.dance import (
    dance_diversity,
    dance_fid,
    dance_multimodality,
    foot_contact_score,
    foot_skating,
)
from motionloom.models.metrics.dance_beats import DEFINITIONS, beat_align
from motionloom.models.metrics.dance_features import kinetic_features, manual_features, zero_start
from motionloom.pipeline.evaluation.dances import DanceClip

Joints = NDArray[np.float64]
Features = dict[str, NDArray[np.float64]]

KINETIC = 3 * BODY_JOINTS
"""Kinetic features of a motion."""

MIN_FRAMES = 4
"""Shortest motion whose figures are taken."""


@dataclass(frozen=True)
class Matched:
    """A motion beside the music that its figures are taken against."""

    joints: Joints
    clip: DanceClip

    @property
    def frames(self) -> int:
        """Frames for which both are there."""
        return min(len(self.joints), len(self.clip.joints))


def alignment_of(rows: Sequence[Matched]) -> dict[str, float]:
    """Mean Beat Align by every public definition; of music without a beat nothing can be said."""
    out: dict[str, list[float]] = {name: [] for name in DEFINITIONS}
    for row in rows:
        joints, fps = row.joints[: row.frames, :BODY_JOINTS], row.clip.fps
        # The last step has no place of its own in every definition.
        inside = row.clip.beats[row.clip.beats < (row.frames - 1) / fps - 1e-6]
        if row.frames < MIN_FRAMES or not len(inside):
            continue
        for name, values in out.items():
            values.append(beat_align(joints, inside, fps, name))
    return {name: float(np.mean(values)) for name, values in out.items() if values}


def recognition_of(rows: Sequence[Matched]) -> dict[str, float]:
    """Shares of motions of their truth's genre and style, and how far the tempo is off.

    `tempo_error` is the mean of |tempo / true tempo - 1|, `tempo` the share within 5 %. Empty where the clips
    have no such truth.
    """
    out: dict[str, list[float]] = {}
    for row in rows:
        truth = row.clip.truth or {}
        if not truth.get("genre") or row.frames < MIN_FRAMES:
            continue
        found = measure_dance(row.joints[: row.frames], row.clip.fps)
        off = abs(found.bpm / float(truth["bpm"]) - 1)
        values = {
            "genre": float(found.genre == truth["genre"]),
            "style": float(found.style == truth["style"]),
            "tempo": float(off <= 0.05),
            "tempo_error": off,
        }
        for name, value in values.items():
            out.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in out.items()}


def feet_of(motions: Sequence[Joints], fps: float) -> dict[str, float]:
    """Share of sliding steps, and EDGE's physical foot contact score."""
    long = [joints for joints in motions if len(joints) >= MIN_FRAMES]
    return {
        "foot_skating": float(np.mean([foot_skating(joints, fps) for joints in long])),
        "foot_contact": float(np.mean([foot_contact_score(joints, fps) for joints in long])),
    }


def features_of(motions: Sequence[Joints], fps: float, feature_fps: float) -> Features:
    """Kinetic ("k") and geometric ("m") features [n, F] of motions, at `feature_fps` frames a second."""
    bodies = [zero_start(resample(joints[:, :BODY_JOINTS], fps, feature_fps)) for joints in motions]
    return {
        "k": np.stack([kinetic_features(body) for body in bodies]),
        "m": np.stack([manual_features(body) for body in bodies]),
    }


def distribution_of(true: Features, found: Features) -> dict[str, float]:
    """FID and Diversity of features, both normalised by the true motions'; nothing of a single motion."""
    out: dict[str, float] = {}
    for kind, rows in found.items():
        if len(rows) > 1 and len(true[kind]) > 1:
            out[f"fid_{kind}"] = dance_fid(true[kind], rows)
            out[f"div_{kind}"] = dance_diversity(true[kind], rows)
    return out


def multimodality_of(true: Features, repeats: Sequence[Features]) -> dict[str, list[float]]:
    """MultiModality of each clip's repeated generations; nothing of a single repetition."""
    if len(repeats) < 2:
        return {}
    out: dict[str, list[float]] = {}
    for kind in true:
        samples = np.stack([features[kind] for features in repeats], axis=1)
        out[f"mm_{kind}"] = [dance_multimodality(true[kind], rows[None]) for rows in samples]
    return out


def chances(clips: Sequence[DanceClip]) -> dict[str, float]:
    """Genre and style by a guess: always the commonest one."""
    out: dict[str, float] = {}
    for name in ("genre", "style"):
        values = [clip.truth[name] for clip in clips if clip.truth and clip.truth.get(name)]
        if values:
            out[name] = max(map(values.count, values)) / len(values)
    return out


def way(found: Mapping[str, Any], shuffled: Mapping[str, Any], true: Mapping[str, Any]) -> dict[str, float]:
    """How far Beat Align goes from shuffled music (0) to the ground truth (1), by each definition.

    Left out where the ground truth is less than 0.01 above shuffled music **[ours]**: then it says nothing.
    """
    out: dict[str, float] = {}
    for name in found:
        room = true[name] - shuffled[name]
        if room >= 0.01:
            out[name] = (found[name] - shuffled[name]) / room
    return out


def others(clips: Sequence[DanceClip], count: int, seed: int) -> list[list[int]]:
    """For each clip at most `count` clips of other songs, drawn at random; none where there is one song."""
    rng = np.random.default_rng(seed)
    out = []
    for clip in clips:
        apart = [k for k, other in enumerate(clips) if other.song != clip.song]
        out.append(rng.permutation(apart)[:count].tolist())
    return out
