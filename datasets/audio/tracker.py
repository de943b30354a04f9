"""Beats and downbeats of music: what the network hears (`beat_net`), decoded into one steady pulse.

Beats are the best path through rows and tempi (55 to 215 beats a minute): a beat wants a high activation,
the rows between two beats want low ones, and the distance of two beats is that of the two before, give or
take a little. So the pulse goes on through a break, and follows a band that hurries. Bars are then the best
way to count the beats by three or by four.

Times lie between rows: a beat is at the centre of its activation's peak.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.bands import ROWS, band_power
from motionloom.datasets.audio.beat_net import activations, levels, load_beat_net
from motionloom.datasets.audio.sound import Sound

SLOWEST, FASTEST = 55.0, 215.0
"""Beats a minute."""
METERS = (4, 3)

PERIODS = np.arange(int(60 * ROWS / FASTEST) + 1, int(60 * ROWS / SLOWEST) + 1)
"""Rows from a beat to the next."""
_OFTEN = (0.02, 0.98)
"""Activations are kept between these: one row alone never decides."""
_UNEVEN = 40.0
"""What it costs to change the tempo, for each e-fold."""
_EAGER = 1.0
"""What each beat gains beside what is heard, in nats: beats that are faint count too."""
_MODERATE = 2.0
"""What it costs, each beat, to be an octave away from 120 beats a minute; more by the square."""
_ROUNDING = 0.4
"""What it costs to go to the next period, as beats do whose distance lies between two."""
_SLIP = 8.0
"""What it costs to begin a bar out of turn, in nats."""


@dataclass(frozen=True, eq=False)
class Beats:
    """The pulse of a piece."""

    times: NDArray[np.float64]
    """[K] seconds, ascending."""
    bar_places: NDArray[np.int64]
    """[K] from 0, a downbeat."""
    meter: int
    """Beats of a bar, 3 or 4."""
    activation: NDArray[np.float32]
    """[T] 0..1, how much each row sounds like a beat, 60 rows a second."""
    confidence: float
    """0..1: how much more the beats sound like beats than the rows between them do."""


def track(sound: Sound) -> Beats:
    """Beats of a whole piece; none where it is shorter than two of the slowest."""
    return track_power(band_power(sound))


def track_power(power: NDArray[np.float32]) -> Beats:
    """The same by the power [T, 64] of a piece's bands."""
    return decode(activations(load_beat_net(), levels(power)))


def decode(heard: NDArray[np.float32]) -> Beats:
    """Probabilities [T, 2] of beats and downbeats -> beats."""
    rows = beat_rows(heard[:, 0])
    places, meter = bar_places(_peak(heard[:, 1], rows))
    times = _between_rows(heard[:, 0], rows) / ROWS
    return Beats(times, places, meter, heard[:, 0].copy(), _confidence(heard[:, 0], rows))


def beat_rows(activation: NDArray[np.float32]) -> NDArray[np.int64]:
    """Activations [T] -> rows of the beats, ascending; none where T is less than two of the slowest beats."""
    periods = PERIODS
    if len(activation) < 2 * periods[-1]:
        return np.empty(0, dtype=np.int64)
    kept = np.clip(activation, *_OFTEN).astype(np.float64)
    # The score of no beat at all is taken off. Beside the piece beats cost nothing, so that the first and the
    # last are within their period from its ends.
    gain = np.pad(np.log(kept) - np.log1p(-kept) + _EAGER, periods[-1])
    change = _change_cost(periods)
    # score[t, i]: of the best beats up to one at row t after which the next follows in periods[i] rows.
    score = np.zeros((len(gain), len(periods)), dtype=np.float32)
    came = np.zeros((len(gain), len(periods)), dtype=np.int8)
    columns = np.arange(len(periods))
    for row in range(periods[-1], len(gain)):
        best = score[row - periods, columns][:, None] - change
        came[row] = best.argmax(axis=0)
        score[row] = best[came[row], columns] + gain[row]
    after = len(gain) - int(periods[-1])
    back, now = divmod(int(score[after:].argmax()), len(periods))
    rows, row = [], after + back
    while row >= periods[-1]:
        rows.append(row - periods[-1])
        now = came[row, now]
        row -= int(periods[now])
    found = np.array(rows[::-1], dtype=np.int64)
    return found[found < len(activation)]


def bar_places(downbeats: NDArray[np.float32]) -> tuple[NDArray[np.int64], int]:
    """Downbeat activations of the beats [K] -> places in the bar [K] and the meter that explains them best.

    Bars go on through the piece; where music was cut, one may begin out of turn.
    """
    kept = np.clip(downbeats, *_OFTEN).astype(np.float64)
    on, off = np.log(kept), np.log1p(-kept)
    found = {meter: _count_bars(on, off, meter) for meter in METERS}
    meter = max(METERS, key=lambda one: found[one][1])
    return found[meter][0], meter


def _count_bars(
    on: NDArray[np.float64], off: NDArray[np.float64], meter: int
) -> tuple[NDArray[np.int64], float]:
    """Places [K] of beats with these log-probabilities of being a downbeat or none, and their score."""
    count = len(on)
    came = np.zeros((count, meter), dtype=np.int64)
    score = np.zeros(meter)
    turn = (np.arange(meter) - 1) % meter
    for beat in range(count):
        if beat:
            slipped = int(score.argmax())
            late = score[slipped] - _SLIP > score[turn]
            came[beat] = np.where(late, slipped, turn)
            score = np.where(late, score[slipped] - _SLIP, score[turn])
        score = score + off[beat]
        score[0] += on[beat] - off[beat]
    places = np.zeros(count, dtype=np.int64)
    place = int(score.argmax())
    for beat in range(count - 1, -1, -1):
        places[beat] = place
        place = int(came[beat, place])
    return places, float(score.max())


def _change_cost(periods: NDArray[np.int64]) -> NDArray[np.float64]:
    """[from, to] between periods: little to a neighbour, much to another tempo, more to an unusual one."""
    apart = np.abs(np.log(periods[:, None] / periods[None]))
    steps = np.abs(periods[:, None] - periods[None])
    change = np.where(steps == 0, 0.0, np.where(steps == 1, _ROUNDING, _ROUNDING + _UNEVEN * apart))
    return np.asarray(change + _MODERATE * np.log2(periods / (ROWS / 2)) ** 2)


def _peak(values: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """The largest of each row and its neighbours."""
    near = np.clip(rows[:, None] + np.arange(-1, 2), 0, len(values) - 1)
    return np.asarray(values[near].max(axis=1))


def _between_rows(values: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Centres of the peaks around rows, at most a row away; rows without a peak stay."""
    places = np.arange(-2, 3)
    near = np.clip(rows[:, None] + places, 0, len(values) - 1)
    weight = values[near].astype(np.float64)
    weight -= weight.min(axis=1, keepdims=True)
    shift = (weight * places).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    return np.asarray(np.maximum(rows + np.clip(shift, -1.0, 1.0), 0.0))


def _confidence(activation: NDArray[np.float32], rows: NDArray[np.int64]) -> float:
    """The mean at the beats, less the mean of what lies midway between two."""
    if len(rows) < 2:
        return 0.0
    middle = (rows[1:] + rows[:-1]) // 2
    contrast = _peak(activation, rows).mean() - _peak(activation, middle).mean()
    return float(np.clip(contrast, 0.0, 1.0))
