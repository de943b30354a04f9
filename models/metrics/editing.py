"""How well what was made joins what was kept: acceleration where they meet, beside that of recorded motion.

A jump between two frames is an acceleration of twice its size in each of them, so that is where seams show
[ours]. All joints count alike, in m/s².
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NEAR = 2
"""Frames on either side of a seam that belong to it."""


def accelerations(joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """Mean size of the joints' accelerations in every inner frame [T - 2], m/s², of joints [T, N, 3]."""
    second = np.diff(np.asarray(joints, dtype=np.float64), n=2, axis=0) * fps**2
    return np.asarray(np.linalg.norm(second, axis=-1).mean(axis=-1))


def seams_of(kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Frames after which it changes what is kept, of kept pieces [T, P] or frames [T]."""
    changes = kept[1:] != kept[:-1]
    return np.flatnonzero(changes if changes.ndim == 1 else changes.any(axis=1))


def seam_acceleration(joints: NDArray[np.floating], fps: float, seams: NDArray[np.int64]) -> float:
    """Mean acceleration of joints [T, N, 3] in the frames around seams; NaN where there are none."""
    size = accelerations(joints, fps)
    inner = np.arange(1, len(joints) - 1)
    near = (np.abs(inner[:, None] - seams - 0.5) < NEAR).any(axis=1) if len(seams) else inner < 0
    return float(size[near].mean()) if near.any() else float("nan")
