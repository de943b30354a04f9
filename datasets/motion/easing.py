"""Values between rows where they are known, along curves that leave and arrive level [ours]."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", np.float64, np.complex128)


def smooth(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shares, held within 0 to 1, that leave and arrive level."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share * share * (3 - 2 * share))


def between_known(
    known: NDArray[np.bool_], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """The rows [R, J] of known [T, J] before, or at, and after, or at, some rows, and how far these are on
    the `smooth` way between them. Where there is none on one side, both are that of the other.
    """
    number = np.arange(len(known))[:, None]
    count = len(known)
    first = np.maximum.accumulate(np.where(known, number, -1), axis=0)[rows]
    last = np.minimum.accumulate(np.where(known, number, count)[::-1], axis=0)[::-1][rows]
    first, last = np.where(first < 0, last, first), np.where(last == count, first, last)
    return first, last, smooth((rows[:, None] - first) / np.maximum(last - first, 1))


def eased(values: NDArray[Number], known: NDArray[np.bool_]) -> NDArray[Number]:
    """Values [T, ...], between known ones, bool [T], along a curve that leaves and arrives level; 0 where
    nothing is known.

    Before the first and after the last known one they stay as these are.
    """
    if not known.any():
        return np.zeros_like(values)
    first, last, share = (one[:, 0] for one in between_known(known[:, None], np.arange(len(values))))
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[first] * (1 - share) + values[last] * share)
