"""Rotations of six columns: the first two rows of their matrices, as these sets store them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError

_SHORTEST = 1e-6
"""A row, or what is left of the second beside the first, that is shorter than this has no direction."""


def matrices_of_rows(rows: NDArray[np.float64], label: str) -> NDArray[np.float64]:
    """[T, N, 6] -> rotation matrices [T, N, 3, 3] by Gram and Schmidt; `UserError` for rows of no length."""
    first, second = rows[..., :3], rows[..., 3:]
    x = _unit(first, label)
    y = _unit(second - (x * second).sum(axis=-1, keepdims=True) * x, label)
    return np.stack([x, y, np.cross(x, y)], axis=-2)


def rotvecs_of_rows(rows: NDArray[np.float64], label: str) -> NDArray[np.float64]:
    """[T, N, 6] -> axis-angles [T, N, 3] in radians."""
    from scipy.spatial.transform import Rotation

    matrices = matrices_of_rows(rows, label)
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
