"""What no body does: feet that slide, bodies above or in the floor, motion that trembles.

Joints are metres [T, N, 3], Y up, the floor at 0, where conversion puts it. Public code measures meshes
(PhysDiff: sliding, floating, penetration) and the jerk of joints (TransPose and its successors: jitter);
here all is measured on joints **[ours]**, so a recorded motion's values are not 0 and belong beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.dance import foot_skating

TOLERANCE = 0.005
"""Metres above the floor that count as on it, as in PhysDiff."""

SHORTEST = 4
"""Frames that a third difference needs."""


class Physics(NamedTuple):
    """Of one motion."""

    skating: float
    """Share of the steps in which a foot slides, see `foot_skating`."""
    floating: float
    """Mean height of the lowest joint above the floor, mm; a jump counts."""
    penetration: float
    """Mean depth of the lowest joint below the floor, mm."""
    jitter: float
    """Mean jerk of the joints, third differences, in units of 100 m/s^3."""


def physics(joints: NDArray[np.floating], fps: float) -> Physics:
    """Of joints [T >= 4, N >= 12, 3]."""
    x = np.asarray(joints, dtype=np.float64)
    if x.ndim != 3 or len(x) < SHORTEST or x.shape[1] < 12 or x.shape[2] != 3:
        raise UserError(f"physics needs joints [T >= 4, N >= 12, 3], not {list(x.shape)}")
    lowest = x[..., 1].min(1)
    jerk = np.linalg.norm(np.diff(x, n=3, axis=0), axis=-1) * fps**3
    return Physics(
        skating=foot_skating(x, fps),
        floating=float(1000 * np.where(lowest > TOLERANCE, lowest, 0.0).mean()),
        penetration=float(1000 * np.where(lowest < -TOLERANCE, -lowest, 0.0).mean()),
        jitter=float(jerk.mean() / 100),
    )
