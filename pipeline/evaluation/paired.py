"""Generated motions beside the ones recorded for the same captions: APE, AVE, and features of movement.

UDE's Tables 1 and 2 give APE and AVE (`models/metrics/position.py`), and Tables 1, 4 and 5 of motions to text
the FID, Diversity and MultiModality of kinetic and geometric features that dances have. The body alone
counts, as UDE has neither hands nor faces, and as many frames as both motions last.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.models.metrics.position import KINDS, PositionErrors, position_errors
from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation.dance_figures import (
    KINETIC,
    MIN_FRAMES,
    Features,
    distribution_of,
    features_of,
    multimodality_of,
)
from motionloom.pipeline.evaluation.figures import Interval

Joints = NDArray[np.float64]

FEATURE_FPS = 60.0
"""Frame rate of the published features."""
POSITION_TITLES = {
    "ape_joints": "APE, m",
    "ave_joints": "AVE, m²",
    "ape_root": "APE root",
    "ave_root": "AVE root",
    "ape_path": "APE path",
    "ave_path": "AVE path",
    "ape_pose": "APE pose",
    "ave_pose": "AVE pose",
}
"""Figure -> title of its column."""
_ERRORS = ("ape", "ave")


def position_row(made: Joints, real: Joints) -> Row:
    """Sums of one motion [T, N, 3] against the recorded one, over the frames that both last."""
    frames = min(len(made), len(real))
    if frames < 2:
        return {}
    pair = (torch.from_numpy(np.ascontiguousarray(x[:frames, :BODY_JOINTS])) for x in (made, real))
    found = position_errors(*pair)
    out = {"frames": float(found.frames)}
    for name, sums in zip(_ERRORS, (found.ape, found.ave), strict=True):
        out |= {f"{name}_{kind}": float(value) for kind, value in zip(KINDS, sums, strict=True)}
    return out


def position_means(rows: Iterable[Row]) -> dict[str, float]:
    """Of `position_row`: APE in m over all frames, AVE in m² over all clips; nothing without rows."""
    total: PositionErrors | None = None
    for row in rows:
        if row:
            ape, ave = (torch.tensor([row[f"{name}_{kind}"] for kind in KINDS]) for name in _ERRORS)
            one = PositionErrors(ape, ave, torch.tensor(row["frames"]), torch.tensor(1.0))
            total = one if total is None else total + one
    return {} if total is None else total.means()


def movement(joints: Joints, fps: float) -> dict[str, NDArray[np.float64]]:
    """Kinetic ("k") and geometric ("m") features [F] of one motion; NaN where it is too short for them."""
    if len(joints) < MIN_FRAMES:
        return {"k": np.full(KINETIC, np.nan), "m": np.full(32, np.nan)}
    return {kind: rows[0] for kind, rows in features_of([joints], fps, FEATURE_FPS).items()}


def paired_figures(
    real: Sequence[Joints],
    others: Sequence[Joints],
    still: Sequence[Joints],
    made: Sequence[tuple[Sequence[Row], Features]],
    fps: float,
) -> dict[str, Any]:
    """`positions` and `movement` of what was generated, beside as many training clips and the mean pose.

    Args:
        real: The recorded motions of n clips.
        others: Training clips, one for each where there are as many.
        still: The mean pose for as long as each.
        made: `position_row` of each clip and features [n, F], once a repeat.
        fps: Frames a second of all of them.
    """
    answers: Mapping[str, Sequence[Joints]] = {"training": others, "mean_pose": still}
    positions: dict[str, Any] = {
        "generated": _intervals([position_means(rows) for rows, _ in made]),
        **{
            name: _intervals([position_means(map(position_row, motions, real))])
            for name, motions in answers.items()
            if len(motions) == len(real)
        },
    }
    true = _stacked(real, fps)
    long = np.logical_and.reduce([_long(true), *(_long(features) for _, features in made)])
    true = _rows(true, long)
    drawn = [_rows(features, long) for _, features in made]
    moves: dict[str, Any] = {"recorded": distribution_of(true, true)}
    moves["recorded"] = _intervals([{k: v for k, v in moves["recorded"].items() if k.startswith("div")}])
    moves["generated"] = _intervals([distribution_of(true, features) for features in drawn])
    moves["generated"] |= {k: Interval.of(v) for k, v in multimodality_of(true, drawn).items()}
    for name, motions in answers.items():
        found = _stacked(motions, fps)
        moves[name] = _intervals([distribution_of(true, _rows(found, _long(found)))])
    return {"positions": positions, "movement": {"clips": int(long.sum()), "rows": moves}}


def _stacked(motions: Sequence[Joints], fps: float) -> Features:
    found = [movement(joints, fps) for joints in motions]
    return {kind: np.stack([one[kind] for one in found]) for kind in ("k", "m")} if found else _NONE


_NONE: Features = {"k": np.zeros((0, KINETIC)), "m": np.zeros((0, 32))}


def _long(features: Features) -> NDArray[np.bool_]:
    """The motions that are long enough for features, [n]."""
    return np.asarray(~np.isnan(features["m"]).any(axis=1))


def _rows(features: Features, keep: NDArray[np.bool_]) -> Features:
    return {kind: rows[keep] for kind, rows in features.items()}


def _intervals(repeats: Sequence[Mapping[str, float]]) -> dict[str, Interval]:
    """Of each figure that every repeat has."""
    names = repeats[0] if repeats else {}
    return {name: Interval.of([row[name] for row in repeats]) for name in names}
