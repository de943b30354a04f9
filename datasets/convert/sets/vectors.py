"""Feature vectors of published sets, turned back: joints seen from a heading, rotations of six columns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
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
    out[..., 2] = plane.real
    out[..., 0] = plane.imag
    return out


_SHORTEST = 1e-6
"""A row, or what is left of the second beside the first, that is shorter than this has no direction."""


def rotvecs_of_rows(rows: NDArray[np.float64], label: str) -> NDArray[np.float64]:
    """First two rows of matrices [T, N, 6] -> axis-angles [T, N, 3]; `UserError` for rows of length 0."""
    from scipy.spatial.transform import Rotation

    first = rows[..., :3]
    second = rows[..., 3:]
    x = _unit(first, label)
    y = _unit(second - (x * second).sum(axis=-1, keepdims=True) * x, label)
    matrices = np.stack([x, y, np.cross(x, y)], axis=-2)
    vectors = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vectors.reshape(*matrices.shape[:2], 3), dtype=np.float64)


def _unit(rows: NDArray[np.float64], label: str) -> NDArray[np.float64]:
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    if not (length > _SHORTEST).all():
        frame, joint = np.argwhere(~(length[..., 0] > _SHORTEST))[0]
        raise UserError(
            f"{label}: no rotation at frame {frame}, joint {joint} (its six columns have no direction)"
        )
    return np.asarray(rows / length, dtype=np.float64)
