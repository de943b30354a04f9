"""Running median of 31 along the first axis, for many columns at once, in min and max alone.

Median filters of harmonic-percussive separation are most of the time of audio features. Sorting every window
by itself repeats almost all of its work: sixteen neighbouring windows of 31 share 16 values. Those are
sorted once, and then, halving the windows that share,

    16 windows: 16 shared values sorted
     8 windows: + 8 values on one side, the middle 8 of the 24 kept
     4 windows: + 4, the middle 4 of 12 kept
     2 windows: + 2, the middle 2 of 6 kept
     1 window:  + 1, the middle of 3: the median

because only a value with as many values to come as separate it from the middle can still be the median.
That is 30 minima or maxima a value, each over whole rows, and the result is exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

WIDTH = 31
REACH = WIDTH // 2

_SHARED = 16
_GROUP = 8192
"""Columns times blocks worked on at once: few calls, yet what one step touches stays in the cache."""


def running_median(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """values [N, M] -> [N, M]: the median of rows i-15 .. i+15, the ends continued by reflection.

    Reflection repeats the end row (d c b a | a b c d | d c b a).
    """
    padded = np.pad(values, ((REACH, REACH), (0, 0)), mode="symmetric")
    return running_median_valid(padded)


def running_median_valid(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """values [N + 30, M] -> [N, M]: the median of rows i .. i+30."""
    rows, columns = len(values) - 2 * REACH, values.shape[1]
    blocks = -(-rows // _SHARED)
    missing = blocks * _SHARED - rows
    if missing:
        values = np.concatenate([values, np.broadcast_to(values[-1:], (missing, columns))])
    out = np.empty((blocks, _SHARED, columns), dtype=values.dtype)
    step, size = values.strides
    # window[b, k] is row 16 b + k: blocks overlap, and nothing is copied.
    window = np.lib.stride_tricks.as_strided(
        values, (blocks, _SHARED + WIDTH - 1, columns), (_SHARED * step, step, size), writeable=False
    )
    many = max(1, _GROUP // columns)
    for first in range(0, blocks, many):
        group = window[first : first + many]
        rows_of = [group[:, k] for k in range(_SHARED + WIDTH - 1)]
        shared = _sorted(rows_of[_SHARED - 1 : WIDTH])
        _descend(shared, rows_of[: _SHARED - 1], rows_of[WIDTH:], out[first : first + many])
    return out.reshape(blocks * _SHARED, columns)[:rows]


def _descend(
    middle: list[NDArray], before: list[NDArray], after: list[NDArray], out: NDArray[np.float32]
) -> None:
    """Medians of len(middle) windows into `out` [blocks, windows, M].

    `middle`: the values still in question of what the windows share, ascending; `before` and `after`: the
    values just before and just after the shared ones.
    """
    count = len(middle)
    if count == 1:
        out[:, 0] = middle[0]
        return
    half = count // 2
    # The first half of the windows shares the values just before; the second, those just after.
    first = _middle(middle, _sorted(before[half - 1 :]))
    _descend(first, before[: half - 1], after[: half - 1], out[:, :half])
    second = _middle(middle, _sorted(after[:half]))
    _descend(second, before[half:], after[half:], out[:, half:])


def _middle(values: list[NDArray], more: list[NDArray]) -> list[NDArray]:
    """The middle third of 2m ascending and m ascending arrays, ascending: two half-cleaners and a merge."""
    m = len(more)
    upper = [np.minimum(values[m + j], more[m - 1 - j]) for j in range(m)]
    for j in range(m):
        np.maximum(values[j], upper[j], out=upper[j])
    return _merged(upper)


def _merged(bitonic: list[NDArray]) -> list[NDArray]:
    """A bitonic sequence in ascending order (its arrays are reused)."""
    span = len(bitonic) // 2
    while span:
        for start in range(0, len(bitonic), 2 * span):
            for i in range(start, start + span):
                _exchange(bitonic, i, i + span)
        span //= 2
    return bitonic


def _sorted(arrays: list[NDArray]) -> list[NDArray]:
    """Copies of 1, 2, 4, 8 or 16 arrays, ascending: Batcher's odd-even merge sort."""
    out = [array.copy() for array in arrays]
    n, size = len(out), 1
    while size < n:
        stride = size
        while stride:
            for low in range(stride % size, n - stride, 2 * stride):
                for i in range(low, min(low + stride, n - stride)):
                    if i // (2 * size) == (i + stride) // (2 * size):
                        _exchange(out, i, i + stride)
            stride //= 2
        size *= 2
    return out


def _exchange(arrays: list[NDArray], low: int, high: int) -> None:
    smaller = np.minimum(arrays[low], arrays[high])
    np.maximum(arrays[low], arrays[high], out=arrays[high])
    arrays[low] = smaller
