"""Figures of generated dances: FID_k and FID_m, Diversity and MultiModality of their features, and feet.

Features are those of `dance_features`, one row a motion. Before anything is compared they are normalised by
mean and standard deviation of the *true* motions' features, as AI Choreographer and Bailando do.

`physics` says what no body does: feet that slide, bodies above or in the floor, motion that trembles, with
the floor at 0, where conversion puts it. Public code measures meshes (PhysDiff: sliding, floating,
penetration) and the jerk of joints (TransPose and its successors: jitter); here all is measured on joints
**[ours]**, so a recorded motion's values are not 0 and belong beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.models.metrics.distributions import fid

Array = NDArray[np.float64]

ANKLES_TOES = ((7, 10), (8, 11))
"""(ankle, toes) of the left and the right foot."""


def normalized_by(true: NDArray[np.floating], features: NDArray[np.floating]) -> Array:
    """`features` [..., F] less the mean, over the deviation, of the true motions' [N, F].

    The published code adds 1e-10 to the deviation, and a statement that no true motion makes (or all of them)
    then decides the figure alone, with 1e15. Such columns are left in their own scale **[ours]**; where the
    generated motions agree on them the figures are the published ones.
    """
    reference = np.asarray(true, dtype=np.float64)
    mean = reference.mean(0)
    std = reference.std(0)
    constant = std <= 1e-9 * np.maximum(1.0, np.abs(mean))
    return np.asarray((np.asarray(features, dtype=np.float64) - mean) / np.where(constant, 1.0, std + 1e-10))


def dance_fid(true: NDArray[np.floating], generated: NDArray[np.floating]) -> float:
    """FID_k or FID_m: Frechet distance of normalised features [N, F] and [M, F]."""
    rows = [torch.from_numpy(normalized_by(true, features)) for features in (true, generated)]
    return float(fid(*rows))


def dance_diversity(true: NDArray[np.floating], features: NDArray[np.floating]) -> float:
    """Div_k or Div_m: mean distance of all pairs of `features` [N >= 2, F], normalised by the true ones."""
    return float(_pairs(normalized_by(true, features)))


def dance_multimodality(true: NDArray[np.floating], features: NDArray[np.floating]) -> float:
    """MM_k or MM_m: mean distance of the samples of one input; features [inputs, samples >= 2, F].

    UDE calls it the average variance of the features and gives no formula; this is the diversity of each
    input's samples, averaged over the inputs **[ours]**.
    """
    return float(np.mean([_pairs(rows) for rows in normalized_by(true, features)]))


def _pairs(rows: Array) -> float:
    distance: float = torch.pdist(torch.from_numpy(rows)).mean().item()
    return distance


def foot_contact_score(joints: NDArray[np.floating], fps: float) -> float:
    """EDGE's physical foot contact score (PFC) of joints [T >= 3, N >= 12, 3], Y up; smaller is better.

    The root cannot accelerate sideways or upwards while both feet move: mean of (left foot speed x right foot
    speed x root acceleration), the last as a share of its largest, times 10000. Feet move metres a frame, and
    a foot is as slow as the slower of ankle and toes.
    """
    x = np.asarray(joints, dtype=np.float64)
    pull = np.diff(x[:, 0], n=2, axis=0) * fps**2
    pull[:, 1] = np.maximum(pull[:, 1], 0.0)
    strength = np.linalg.norm(pull, axis=-1)
    top = float(strength.max())
    if top == 0:
        return 0.0
    flat = np.linalg.norm(np.diff(x[1:, :, [0, 2]], axis=0), axis=-1)
    left, right = (flat[:, list(foot)].min(1) for foot in ANKLES_TOES)
    return float((left * right * strength / top).mean() * 10_000)


def foot_skating(joints: NDArray[np.floating], fps: float) -> float:
    """Share of the steps in which a foot slides: below 0.05 m and faster than 0.5 m/s **[ours]**.

    Joints [T >= 2, N >= 12, 3], Y up; the floor is the lowest joint of the motion. A step of the toes
    from frame t to t + 1 counts as low when both its frames are; each foot counts on its own.
    """
    x = np.asarray(joints, dtype=np.float64)
    toes = x[:, [toe for _, toe in ANKLES_TOES]]
    low = toes[..., 1] - x[..., 1].min() < 0.05
    fast = np.linalg.norm(np.diff(toes[..., [0, 2]], axis=0), axis=-1) * fps > 0.5
    return float((low[1:] & low[:-1] & fast).mean())


TOLERANCE = 0.005
"""Metres above the floor that count as on it, as in PhysDiff."""

SHORTEST = 4
"""Frames that a third difference needs."""


class Physics(NamedTuple):
    """Metrics of one motion."""

    skating: float
    """Share of the steps in which a foot slides, see `foot_skating`."""
    floating: float
    """Mean height of the lowest joint above the floor, mm; a jump counts."""
    penetration: float
    """Mean depth of the lowest joint below the floor, mm."""
    jitter: float
    """Mean jerk of the joints, third differences, in units of 100 m/s^3."""


def physics(joints: NDArray[np.floating], fps: float) -> Physics:
    """Return the metrics of joints [T >= 4, N >= 12, 3]."""
    x = np.asarray(joints, dtype=np.float64)
    lowest = x[..., 1].min(1)
    jerk = np.linalg.norm(np.diff(x, n=3, axis=0), axis=-1) * fps**3
    return Physics(
        skating=foot_skating(x, fps),
        floating=float(1000 * np.where(lowest > TOLERANCE, lowest, 0.0).mean()),
        penetration=float(1000 * np.where(lowest < -TOLERANCE, -lowest, 0.0).mean()),
        jitter=float(jerk.mean() / 100),
    )
