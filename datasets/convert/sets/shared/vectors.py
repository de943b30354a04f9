"""Feature vectors that hold joints seen from a heading, and steps of the root: turned back into joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import ground


def walked(
    positions: NDArray[np.float64], heading: NDArray[np.float64], steps: NDArray[np.float64]
) -> NDArray[np.float64]:
    """World joints [T, N, 3] from joints seen from the root's heading, above the origin in every frame.

    `heading` [T] is by how much each frame was turned about Y, in radians; `steps` [T - 1, 2] are the x and z
    by which the root goes on from frame t to t + 1, seen from the heading of frame t.
    """
    back = np.exp(-1j * heading)
    root = np.concatenate([[0j], np.cumsum((steps[:, 1] + 1j * steps[:, 0]) * back[:-1])])
    plane = ground(positions) * back[:, None] + root[:, None]
    out = np.array(positions, dtype=np.float64)
    out[..., 2], out[..., 0] = plane.real, plane.imag
    return out
