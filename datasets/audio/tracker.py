"""Beats and downbeats of music: activations of the beat network (`beat_net`), decoded into one steady pulse.

Beats are the best path through rows and tempi (55 to 215 beats a minute), by dynamic programming: activation
is high on a beat and low between two, and the distance of two beats is nearly that of the two before. So the
pulse goes on through a break, and follows a band that hurries. Bars are then the best way to count the beats
by three or by four.

Times lie between rows: a beat is at the centre of its activation's peak.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.beat_net import ROWS, activations, band_power, levels, load_beat_net
from motionloom.datasets.audio.sound import Sound

SLOWEST, FASTEST = 55.0, 215.0
"""Beats a minute."""
METERS = (4, 3)

PERIODS = np.arange(int(60 * ROWS / FASTEST) + 1, int(60 * ROWS / SLOWEST) + 1)
"""Rows from a beat to the next."""
_OFTEN = (0.02, 0.98)
"""Activations are kept between these: one row alone never decides."""
_UNEVEN = 40.0
"""Cost of changing the tempo, in nats for each e-fold."""
_EAGER = 1.0
"""Gain of each beat beside its activation, in nats: faint beats count too."""
_MODERATE = 2.0
"""Cost of each beat at an octave from 120 beats a minute, in nats; it grows by the square."""
_ROUNDING = 0.4
"""Cost of going to the next period, as beats do whose distance lies between two."""
_SLIP = 8.0
"""Cost of beginning a bar out of turn, in nats."""


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
    """0..1: how much more the beats sound like beats than the rows midway between them do."""
    pulse: float = 1.0
    """0..1: how much the beats sound like beats, on the mean."""


NO_BEAT = 0.33
"""Pulse below which hardly a beat is heard: noise has 0.17 to 0.27, speech 0.08, 49 songs 0.4 to 0.9."""
UNSURE = 0.25
"""Confidence below which the beats may be half a beat off. Of the 25 songs by which choices are made, 4 of 22
whose beats are right and 2 of 3 whose beats are wrong are below."""
_tracked: WeakKeyDictionary[Sound, Beats] = WeakKeyDictionary()


def track(sound: Sound, power: NDArray[np.float32] | None = None) -> Beats:
    """Return the beats of a piece, given or found once; none in one too short. `power` [T, 64]: its bands."""
    if sound not in _tracked:
        levels_in = levels(band_power(sound) if power is None else power)
        heard = activations(load_beat_net(), levels_in)
        given = (sound.piece or sound).beats
        _tracked[sound] = decode(heard) if given is None else _given(given - sound.begin, heard)
    return _tracked[sound]


def _given(times: NDArray[np.float64], heard: NDArray[np.float32]) -> Beats:
    """Beats at times that somebody gave: certain, and heard in bars as far as there are any."""
    times = times[(times >= 0.0) & (times * ROWS < len(heard))]
    rows = np.round(times * ROWS).astype(np.int64)
    places, meter = bar_places(_peak(heard[:, 1], rows))
    activation = np.zeros(len(heard), dtype=np.float32)
    for away, level in ((-1, 0.5), (1, 0.5), (0, 1.0)):
        activation[np.clip(rows + away, 0, len(heard) - 1)] = level
    return Beats(times, places, meter, activation, 1.0)


def decode(probabilities: NDArray[np.float32]) -> Beats:
    """Return the beats of probabilities [T, 2] of beats and downbeats."""
    beat = probabilities[:, 0]
    downbeat = probabilities[:, 1]
    rows = beat_rows(beat)
    places, meter = bar_places(_peak(downbeat, rows))
    pulse = 0.0
    confidence = 0.0
    if len(rows) > 1:  # the mean at the beats, less the mean midway between two
        middle = (rows[1:] + rows[:-1]) // 2
        pulse = float(_peak(beat, rows).mean())
        confidence = float(np.clip(pulse - _peak(beat, middle).mean(), 0.0, 1.0))
    return Beats(_between_rows(beat, rows) / ROWS, places, meter, beat.copy(), confidence, pulse)


def beat_rows(activation: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the rows of the beats of activations [T], ascending; none where T is below two slowest beats."""
    periods = PERIODS
    if len(activation) < 2 * periods[-1]:
        return np.empty(0, dtype=np.int64)
    kept = np.clip(activation, *_OFTEN).astype(np.float64)
    # Log odds: the score of no beat at all is taken off. Beats beside the piece cost nothing, so that the
    # first and the last may lie anywhere within their period from its ends.
    gain = np.pad(np.log(kept) - np.log1p(-kept) + _EAGER, periods[-1])
    change = _change_cost(periods)
    # Viterbi: score[t, i] is of the best beats up to one at row t, the next being periods[i] rows later.
    score = np.zeros((len(gain), len(periods)), dtype=np.float32)
    came = np.zeros((len(gain), len(periods)), dtype=np.int8)
    columns = np.arange(len(periods))
    for row in range(periods[-1], len(gain)):
        best = score[row - periods, columns][:, None] - change
        came[row] = best.argmax(axis=0)
        score[row] = best[came[row], columns] + gain[row]
    # The best end is a beat in the padding behind the piece; from there the path is followed back.
    after = len(gain) - int(periods[-1])
    back, now = divmod(int(score[after:].argmax()), len(periods))
    rows = []
    row = after + back
    while row >= periods[-1]:
        rows.append(row - periods[-1])
        now = came[row, now]
        row -= int(periods[now])
    beats = np.array(rows[::-1], dtype=np.int64)
    return beats[beats < len(activation)]


def bar_places(downbeats: NDArray[np.float32]) -> tuple[NDArray[np.int64], int]:
    """Return places in the bar [K] and the meter that explain the beats' downbeat activations [K] best.

    Bars go on through the piece; where music was cut, one may begin out of turn.
    """
    kept = np.clip(downbeats, *_OFTEN).astype(np.float64)
    on = np.log(kept)
    off = np.log1p(-kept)
    counts = {meter: _count_bars(on, off, meter) for meter in METERS}
    meter = max(METERS, key=lambda one: counts[one][1])
    return counts[meter][0], meter


def _count_bars(
    on: NDArray[np.float64], off: NDArray[np.float64], meter: int
) -> tuple[NDArray[np.int64], float]:
    """Return places [K] of beats, by log-probabilities `on` and `off` of a downbeat, and their score."""
    count = len(on)
    came = np.zeros((count, meter), dtype=np.int64)
    score = np.zeros(meter)
    turn = (np.arange(meter) - 1) % meter
    for beat in range(count):
        if beat:
            # A beat follows its turn, or the best place of all where a slip costs less than it gains.
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
    """Return costs [from, to] of periods: little to a neighbour, much to another or an unusual tempo."""
    apart = np.abs(np.log(periods[:, None] / periods[None]))
    steps = np.abs(periods[:, None] - periods[None])
    change = np.where(steps == 0, 0.0, np.where(steps == 1, _ROUNDING, _ROUNDING + _UNEVEN * apart))
    return np.asarray(change + _MODERATE * np.log2(periods / (ROWS / 2)) ** 2)


def _peak(values: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the largest value of each row and its two neighbours."""
    near = np.clip(rows[:, None] + np.arange(-1, 2), 0, len(values) - 1)
    return np.asarray(values[near].max(axis=1))


def _between_rows(values: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the centres of the peaks around rows, at most a row away; rows without a peak stay."""
    places = np.arange(-2, 3)
    near = np.clip(rows[:, None] + places, 0, len(values) - 1)
    weight = values[near].astype(np.float64)
    weight -= weight.min(axis=1, keepdims=True)
    shift = (weight * places).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    return np.asarray(np.maximum(rows + np.clip(shift, -1.0, 1.0), 0.0))
