"""Random choices that are pure functions of a key, so any rank, worker or restarted run draws the same ones.

Nothing here keeps state. `numpy.random.Generator.permutation` is not promised to stay the same between numpy
releases, raw bit generator output is; so the permutation sorts raw PCG64 words. Draws for many (clip, draw)
pairs at once use the splitmix64 finaliser as a counter-based hash, because building one bit generator per
clip is 50 times slower.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MUL_1 = np.uint64(0xBF58476D1CE4E5B9)
_MUL_2 = np.uint64(0x94D049BB133111EB)


def permutation(count: int, *key: int) -> NDArray[np.int64]:
    """A permutation of `0 .. count-1` ([count]) decided by `key` (non-negative integers) alone."""
    return np.argsort(words(count, *key), kind="stable")


def words(count: int, *key: int) -> NDArray[np.uint64]:
    """`count` random 64-bit words decided by `key` (non-negative integers) alone."""
    raw: NDArray[np.uint64] = np.random.PCG64(np.random.SeedSequence(key)).random_raw(count)
    return raw


def uniform(*counters: ArrayLike) -> NDArray[np.float64]:
    """Numbers in [0, 1), one per element of the broadcast integer `counters`, decided by their values alone.

    The order of the counters matters: `uniform(seed, epoch, clips[:, None], draws[None])` is [clips, draws].
    """
    state: NDArray[np.uint64] = np.zeros((), dtype=np.uint64)
    with np.errstate(over="ignore"):  # arithmetic modulo 2^64 is the point
        for counter in counters:
            state = _mix(state + _GAMMA + np.asarray(counter).astype(np.uint64))
    return (state >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    x = (x ^ (x >> np.uint64(30))) * _MUL_1
    x = (x ^ (x >> np.uint64(27))) * _MUL_2
    return x ^ (x >> np.uint64(31))
