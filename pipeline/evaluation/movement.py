"""FID, Diversity and MultiModality of kinetic and geometric features (UDE 4.3, Tables 1 to 5).

Features are those of `models/metrics/dance_features.py` on the body's 22 joints, with the first root at the
origin and at the published 60 frames a second: motions of other rates are resampled linearly **[ours]**,
which leaves no acceleration within their own frames. SMPL's two hand joints, which publications count as
well, are missing here, so the figures compare within this program and not with papers.

The published reference is *all* motions of the data, training and test (Bailando's `metrics_new.py`, from
which UDE's row of recorded motion comes): `fid_k`, `fid_m`, `div_k`, `div_m`, `mm_k`, `mm_m`. Beside them
**[ours]** stand distances to the evaluated clips alone, `fid_k_test` and so on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.models.metrics.dance import dance_diversity, dance_fid, dance_multimodality, normalized_by
from motionloom.models.metrics.dance_features import kinetic_features, manual_features, zero_start
from motionloom.pipeline.evaluation.clip_metrics import MIN_FRAMES, Joints
from motionloom.pipeline.evaluation.estimate import estimate, set_estimates
from motionloom.pipeline.evaluation.figures import (
    MODEL,
    Better,
    Estimate,
    Figure,
    Metric,
    Protocol,
    decodings_of,
    group_figures,
)

Features = dict[str, NDArray[np.float64]]
"""Kinetic ("k") and geometric ("m") features [n, F], of a motion [F]."""

FEATURE_FPS = 60.0
"""Frame rate of the published features."""
WIDTHS = {"k": 3 * BODY_JOINTS, "m": 32}
"""Columns of each kind."""
_KINDS: tuple[tuple[str, str, Better], ...] = (("fid", "FID", "lower"), ("div", "Div", ""), ("mm", "MM", ""))
METRICS = tuple(
    Metric(f"movement.{name}_{kind}{suffix}", f"{title}_{kind}{reference}", better)
    for suffix, reference in (("", ""), ("_test", ", to the test clips"))
    for name, title, better in _KINDS
    for kind in WIDTHS
    if not (suffix and name == "mm")
)


def features_of(joints: Joints, fps: float) -> Features:
    """Features [F] of one motion [T, N, 3]; NaN where it is too short for them."""
    if len(joints) < MIN_FRAMES:
        return {kind: np.full(width, np.nan) for kind, width in WIDTHS.items()}
    body = zero_start(resample(joints[:, :BODY_JOINTS], fps, FEATURE_FPS))
    return {"k": kinetic_features(body), "m": manual_features(body)}


def all_features(motions: Iterable[Joints], fps: float) -> Features:
    """Features [n, F] of n motions."""
    each = [features_of(joints, fps) for joints in motions]
    return {
        kind: np.stack([one[kind] for one in each]) if each else np.zeros((0, width))
        for kind, width in WIDTHS.items()
    }


def distances(reference: Features, found: Features, suffix: str = "") -> dict[str, float]:
    """FID and Diversity of features, both normalised by the reference's; nothing of a single motion."""
    out: dict[str, float] = {}
    for kind, rows in found.items():
        if len(rows) > 1 and len(reference[kind]) > 1:
            out[f"movement.fid_{kind}{suffix}"] = dance_fid(reference[kind], rows)
            out[f"movement.div_{kind}{suffix}"] = dance_diversity(reference[kind], rows)
    return out


def multimodality(reference: Features, repeats: Sequence[Features]) -> dict[str, Estimate]:
    """Distances between the repeated generations of each clip; nothing of a single repetition."""
    out: dict[str, Estimate] = {}
    for kind in reference if len(repeats) > 1 else ():
        samples = np.stack([features[kind] for features in repeats], axis=1)
        each = [dance_multimodality(reference[kind], rows[None]) for rows in samples]
        out[f"movement.mm_{kind}"] = estimate([each])
    return out


def movement_figures(
    reference: Features, real: Features, rows: Mapping[str, Sequence[Features]], protocol: Protocol
) -> list[Figure]:
    """Figures of what was generated and of answers that need no model.

    Args:
        reference: Features of all motions of the data.
        real: Those of the evaluated clips.
        rows: Row -> repeats; each repeat of the model has a motion for each of the clips.
        protocol: How all was measured.
    """
    # Clips that some repeat ends too early for features are left out of all of them.
    kept = np.logical_and.reduce([_long(real), *(_long(one) for one in rows.get(MODEL, ()))])
    reference = _rows(reference, _long(reference))
    real = _rows(real, kept)
    found: dict[str, dict[str, Estimate]] = {}
    for row, repeats in rows.items():
        motions = [_rows(one, kept if row == MODEL else _long(one)) for one in repeats]
        each = [distances(reference, one) | distances(real, one, "_test") for one in motions]
        found[row] = set_estimates(each, decodings_of(protocol) if row == MODEL else 1)
        if row == MODEL and kept.any():
            found[row] |= multimodality(reference, motions)
    count = int(kept.sum())
    size = len(reference["k"])
    facts = {**protocol, "motions": count, "reference": size}
    title = "Kinetic (k) and geometric (m) features: distance to all motions, training and test, and variety"
    notes = _few(count, size)
    made = [_rows(one, kept)["m"] for one in rows.get(MODEL, ())]
    for name, true in (("movement.fid_m", reference["m"]), ("movement.fid_m_test", real["m"])):
        if made and count and (rare := _rare(true, np.concatenate(made))):
            notes[name] = "; ".join(filter(None, (notes.get(name), rare)))
    return group_figures(title, METRICS, found, facts, notes)


def _few(count: int, size: int) -> dict[str, str]:
    """Why a FID of fewer motions than columns cannot be trusted: its covariance is not of full rank."""
    return {
        f"movement.fid_{kind}{suffix}": f"{few} motions for {width} columns, too few to be trusted"
        for kind, width in WIDTHS.items()
        for suffix, few in (("", min(count, size)), ("_test", count))
        if few <= width
    }


def _rare(true: NDArray[np.float64], made: NDArray[np.float64]) -> str:
    """Which geometric statement is most of FID_m, if one is; else nothing.

    Features are divided by the deviation of the true motions. A statement that one of 500 makes deviates by
    so little that the few made motions that make it, or none of them, decide the distance.
    """
    moved = normalized_by(true, made)
    own = normalized_by(true, true)
    # The distance of each column alone, as if the columns were independent.
    parts = np.square(moved.mean(0)) + np.square(moved.std(0) - own.std(0))
    most = int(parts.argmax())
    if parts[most] <= parts.sum() / 2:
        return ""
    values = true[:, most]
    unlike = int((values != np.median(values)).sum())
    return (
        f"{100 * parts[most] / parts.sum():.0f} % of it is statement {most + 1} of {len(parts)}, in which "
        f"{unlike} of {len(true)} recorded motions differ from the others"
    )


def _long(features: Features) -> NDArray[np.bool_]:
    """The motions that are long enough for features, [n]."""
    return np.asarray(~np.isnan(features["m"]).any(axis=1))


def _rows(features: Features, keep: NDArray[np.bool_]) -> Features:
    return {kind: rows[keep] for kind, rows in features.items()}
