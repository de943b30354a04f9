"""The error of each joint, so that the report can draw where on the body a tokenizer errs, in millimetres.

`joint_errors_mm`: each joint's distance with the root of each frame moved to the origin, as `mpjpe` has it,
mean over the frames of all clips; where every clip has hands, the mean over joints is `mpjpe`.
`hand_joint_errors_mm`: the finger joints' from their wrist, as `mpjpe_hand` has it, left hand first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS
from motionloom.datasets.schema import HANDS
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth
from motionloom.pipeline.store.networks import TrainedTokenizer

DIGITS = 2


@dataclass(frozen=True)
class JointMapFigures:
    """Errors of joints, and of clips."""

    figures: dict[str, Any]
    """What `metrics.json` gets; None stands for joints that no clip has."""
    clips: list[float]
    """Of each clip, mean over its joints and frames, mm."""


def joint_map(tokenizer: TrainedTokenizer, truths: Sequence[Truth]) -> JointMapFigures:
    """Errors of the reconstructions of `truths`."""
    joints = tokenizer.layout.num_joints
    sums, frames = np.zeros(joints), np.zeros(joints)
    fingers = np.zeros(joints - BODY_JOINTS)
    clips = []
    for truth in truths:
        made = joints_of(reconstruct_truth(tokenizer, truth), tokenizer.layout)
        there = joints if truth.present & HANDS else BODY_JOINTS
        each = distances(made, truth.joints)[:, :there]
        clips.append(float(each.mean()))
        sums[:there] += each.sum(0)
        frames[:there] += len(each)
        if there > BODY_JOINTS:
            fingers += finger_distances(made, truth.joints).sum(0)
    figures: dict[str, Any] = {"joint_errors_mm": _means(sums, frames)}
    if len(fingers) and frames[-1]:
        figures["hand_joint_errors_mm"] = _means(fingers, frames[BODY_JOINTS:])
    return JointMapFigures({"skeleton": tokenizer.layout.skeleton.name, **figures}, clips)


def distances(made: NDArray[Any], real: NDArray[Any]) -> NDArray[np.float64]:
    """Distance of each joint of [T, N, 3] metres from its own, roots at the origin: [T, N] mm."""
    return _lengths((made - made[:, :1]) - (real - real[:, :1]))


def finger_distances(made: NDArray[Any], real: NDArray[Any]) -> NDArray[np.float64]:
    """Likewise of the finger joints, each hand's wrist at the origin: [T, N - 22] mm."""
    count = (made.shape[1] - BODY_JOINTS) // len(WRISTS)
    out = []
    for hand, wrist in enumerate(WRISTS):
        fingers = slice(BODY_JOINTS + hand * count, BODY_JOINTS + (hand + 1) * count)
        local = [motion[:, fingers] - motion[:, wrist : wrist + 1] for motion in (made, real)]
        out.append(_lengths(local[0] - local[1]))
    return np.concatenate(out, axis=1)


def _lengths(difference: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(1000 * np.linalg.norm(difference.astype(np.float64), axis=-1))


def _means(sums: NDArray[np.float64], frames: NDArray[np.float64]) -> list[float | None]:
    pairs = zip(sums.tolist(), frames.tolist(), strict=True)
    return [round(total / count, DIGITS) if count else None for total, count in pairs]
