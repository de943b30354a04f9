"""Rotation helpers that roma and scipy do not have: many small products, and turning one direction into
another.

Matrices here are axes-first, [3, 3, ...]: each entry is one contiguous array over joints and frames, which
makes a product of 3 x 3 matrices seven times faster in numpy than `matmul` on [..., 3, 3].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def axes_first(matrices: NDArray[np.floating]) -> NDArray[np.float64]:
    """[..., N, 3, 3] -> contiguous [3, 3, N, ...]."""
    return np.ascontiguousarray(np.moveaxis(matrices, (-2, -1, -3), (0, 1, 2)), dtype=np.float64)


def axes_last(matrices: NDArray[np.floating]) -> NDArray[np.float64]:
    """[3, 3, N, ...] -> contiguous [..., N, 3, 3]."""
    return np.ascontiguousarray(np.moveaxis(matrices, (0, 1, 2), (-2, -1, -3)), dtype=np.float64)


def multiply(left: NDArray[np.floating], right: NDArray[np.floating]) -> NDArray[np.float64]:
    """Matrix product over the two first axes: [3, 3, ...] times [3, K, ...] -> [3, K, ...]; the rest
    broadcasts.
    """
    out = left[:, 0, None] * right[0]
    out += left[:, 1, None] * right[1]
    out += left[:, 2, None] * right[2]
    return np.asarray(out, dtype=np.float64)


def swing(old: NDArray[np.float64], new: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smallest rotation between unit vectors: `old` [3, ...] and `new` [3, ...] -> [3, 3, ...] with R old =
    new.

    Opposite vectors give half a turn about a line at right angles. The two shapes broadcast after the first
    axis.
    """
    x = old[1] * new[2] - old[2] * new[1]
    y = old[2] * new[0] - old[0] * new[2]
    z = old[0] * new[1] - old[1] * new[0]
    cosine = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
    # R = cos I + [c]x + c c^T / (1 + cos) with c = old x new. Near opposite vectors 1 + cos loses its digits,
    # but equals |c|^2 / (1 - cos); at opposite ones both are 0.
    share = 1.0 / np.maximum(1.0 + cosine, 1e-16)
    near = cosine < -0.99
    opposite = near
    if near.any():
        square = x * x + y * y + z * z
        opposite = near & (square < 1e-24)
        share[near] = (1.0 - cosine[near]) / np.maximum(square[near], 1e-24)
    out = np.empty((3, 3, *cosine.shape))
    out[0, 0] = cosine + x * x * share
    out[1, 1] = cosine + y * y * share
    out[2, 2] = cosine + z * z * share
    for row, column, product, rest in ((0, 1, x * y, z), (0, 2, x * z, -y), (1, 2, y * z, x)):
        product *= share
        out[row, column] = product - rest
        out[column, row] = product + rest
    if opposite.any():
        start = np.broadcast_to(old, (3, *cosine.shape))[:, opposite]
        out[:, :, opposite] = _half_turn(start)
    return out


def _half_turn(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half turns [3, 3, M] that reverse unit vectors [3, M]."""
    spare = np.cross(vectors, np.eye(3)[:, np.abs(vectors).argmin(axis=0)], axis=0)
    spare /= np.linalg.norm(spare, axis=0)
    return np.asarray(2.0 * spare[:, None] * spare[None] - np.eye(3)[:, :, None], dtype=np.float64)
