"""Intervals: how far a figure may be off by chance, 95 % of the time.

One function for all figures. Repeated measurements of a whole set, [R], vary with the draws of the model and
of the batches: Student's t over three repeats or more, and both values of two. What is measured clip by clip,
[R, n], varies with the clips as well, which the repeats draw again and again: a bootstrap over clips, each
taken with all of its repeats, with the quantile of Student's t for n clips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motionloom.pipeline.evaluation.figures import Estimate

RESAMPLES = 1000
"""Draws of the bootstrap: the error of a standard deviation from so many is about 2 %."""
LEVEL = 0.95

_WEIGHT = "|weight"
"""Ends the name of the weight of a clip's value: "mpjpe|weight" is its number of frames."""


def estimate(values: ArrayLike, weights: ArrayLike | None = None) -> Estimate:
    """Mean and half of its 95 % interval.

    Args:
        values: [R] repeated measurements, or [R, n] values of n clips; NaN where a clip has none.
        weights: [R, n], of each value, such as its number of frames; 1 by default.
    """
    measured = np.asarray(values, dtype=np.float64)
    # Repeats of a whole set: they vary with the draws alone.
    if measured.ndim == 1:
        return _over_repeats(measured)
    finite = np.isfinite(measured)
    weight = np.where(finite, 1.0 if weights is None else np.asarray(weights, dtype=np.float64), 0.0)
    # A clip counts once, with the sum of its repeats: repeats of one clip are no further clips.
    total = (np.where(finite, measured, 0.0) * weight).sum(0)
    each = weight.sum(0)
    total = total[each > 0]
    each = each[each > 0]
    mean = float(total.sum() / each.sum())
    if len(each) < 2 or np.ptp(total / each) == 0.0:  # nothing varied
        return Estimate(mean, count=len(each))
    counts = _resamples(len(each))
    spread = float(((counts @ total) / (counts @ each)).std())
    # A bootstrap's variance is (n - 1) / n of the sample's.
    spread *= np.sqrt(len(each) / (len(each) - 1))
    return Estimate(mean, _quantile(len(each)) * spread, "clips", len(each))


def _over_repeats(values: NDArray[np.float64]) -> Estimate:
    mean = float(values.mean())
    if len(values) < 2 or np.ptp(values) == 0.0:  # nothing varied
        return Estimate(mean)
    if len(values) == 2:  # Student's t of one degree of freedom would multiply their difference by six
        return Estimate(mean, over="repeats", pair=tuple(values.tolist()))
    half = _quantile(len(values)) * values.std(ddof=1) / np.sqrt(len(values))
    return Estimate(mean, float(half), "repeats")


def _quantile(count: int) -> float:
    """Quantile of Student's t for a two-sided 95 % interval of the mean of `count` values."""
    from scipy.special import stdtrit  # half a second that commands without figures need not wait

    return float(stdtrit(count - 1, 0.5 + LEVEL / 2))


@lru_cache(maxsize=8)
def _resamples(count: int) -> NDArray[np.float64]:
    """Counts of a bootstrap, [RESAMPLES, count]: draws of each of `count` clips; the same for all figures."""
    drawn = np.random.default_rng(count).multinomial(count, np.full(count, 1 / count), size=RESAMPLES)
    return drawn.astype(np.float64)


def row_estimates(repeats: Sequence[Sequence[Mapping[str, float]]]) -> dict[str, Estimate]:
    """Estimates of what was measured clip by clip: one row of named values for each clip, once a repeat."""
    names = dict.fromkeys(name for rows in repeats for row in rows for name in row)
    out = {}
    for name in names:
        if name.endswith(_WEIGHT):
            continue
        values = [[row.get(name, np.nan) for row in rows] for rows in repeats]
        if np.isfinite(values).any():
            weights = [[row.get(name + _WEIGHT, 1.0) for row in rows] for rows in repeats]
            out[name] = estimate(values, weights)
    return out


def weighted(name: str, total: float, weight: float) -> dict[str, float]:
    """A clip's mean and its weight, as rows have them; nothing without weight."""
    return {name: total / weight, name + _WEIGHT: weight} if weight > 0 else {}


def set_estimates(repeats: Sequence[Mapping[str, float]], nested: int = 1) -> dict[str, Estimate]:
    """Estimates of what was measured of a whole set: named values, once a repeat.

    `nested` repeats one after another are of the same tokens: their mean counts as one, where there are
    several such.
    """
    names = dict.fromkeys(name for row in repeats for name in row)
    if 1 < nested < len(repeats):
        parts = (repeats[first : first + nested] for first in range(0, len(repeats), nested))
        repeats = [{name: one.value for name, one in set_estimates(part).items()} for part in parts]
    return {name: estimate([row[name] for row in repeats if name in row]) for name in names}


def plain(values: Mapping[str, float]) -> dict[str, Estimate]:
    """Values that were not repeated."""
    return {name: Estimate(float(value)) for name, value in values.items()}
