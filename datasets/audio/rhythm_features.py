"""A small description of music for dances, the same for a rendered song and for a recording.

| columns | what |
|---|---|
| beat, two-beat and bar phase | cosine and sine; 0 on the beat and on the downbeat, even in between |
| activation, tempo, confidence | of beats; octaves above 120 beats a minute; of the piece (`tracker`) |
| loudness, low, middle, high | decibels against the piece's median, in units of its range; -2..2 |
| onset | rise over the bands, in units of the piece's strong ones; 0..2 |
| slow loudness, novelty | loudness over two seconds; how much the four seconds that follow are louder |
| brightness, bass, dynamics | of the piece: balance of its bands, and its range |

Everything is relative to the whole piece, so gain does not count and an equaliser counts in the last columns
alone. Where no beat was found, phases are 0, which is no point of the circle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.beat_net import ROWS, band_from, band_power
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import Beats, track

COLUMNS = (
    "beat_cos", "beat_sin", "two_beat_cos", "two_beat_sin", "bar_cos", "bar_sin",
    "activation", "tempo", "confidence",
    "loudness", "low", "middle", "high", "onset", "slow_loudness", "novelty",
    "brightness", "bass", "dynamics",
)  # fmt: skip
RHYTHM_DIM = len(COLUMNS)

_SPLIT = (band_from(250.0), band_from(2500.0))
"""The bands from which on is middle and high."""
_SILENCE = 1e-7
"""Power against the piece's loudest row: 70 dB below it is silence."""
_SMALLEST_RANGE = 6.0
"""Decibels; music that is louder and softer by less is not stretched."""


def rhythm_features(sound: Sound, fps: float, frames: int) -> NDArray[np.float32]:
    """Return features of a whole piece, float32 [frames, 19]; row k is at k / fps s, the last one repeats."""
    power = band_power(sound)
    beats = track(sound, power)
    at = np.minimum(np.arange(frames) / fps, max(0.0, sound.seconds))
    out = np.empty((frames, RHYTHM_DIM), dtype=np.float32)
    out[:, 0:6] = _phases(beats, at)
    out[:, 6] = _peaks_at(beats.activation, at, fps)
    out[:, 7] = _tempo(beats, at)
    out[:, 8] = beats.confidence
    out[:, 9:16], dynamics = _dynamics(power, at, fps)
    out[:, 16:18] = _balance(power)
    out[:, 18] = dynamics
    return out


def beats_of_rows(rows: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """Return seconds of the beats that the phases of features [F, 19] pass; none where no beat was found."""
    if len(rows) < 2 or not rows[:, :2].any():
        return np.empty(0)
    # The phase of the beat runs from 0 to 1; where it passes 1 between two rows lies a beat.
    turns = np.arctan2(rows[:, 1], rows[:, 0]).astype(np.float64) / (2 * np.pi)
    phase = np.round(turns, 6) % 1.0
    step = np.diff(phase) % 1.0
    passes = np.flatnonzero(phase[:-1] + step >= 1.0 - 1e-9)
    seconds = (passes + (1.0 - phase[passes]) / step[passes]) / fps
    return np.concatenate([[0.0], seconds]) if phase[0] == 0.0 else seconds


def _phases(beats: Beats, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """[F, 6] of seconds [F]."""
    if len(beats.times) < 2:
        return np.zeros((len(at), 6))
    # A circle's cosine and sine have no jump at the beat, as a phase itself has.
    times = beats.times
    # Beats since the first; before it and after the last they go on as beside it.
    before_first = np.minimum(at - times[0], 0.0) / (times[1] - times[0])
    after_last = np.maximum(at - times[-1], 0.0) / (times[-1] - times[-2])
    number = np.interp(at, times, np.arange(len(times))) + before_first + after_last
    before = np.clip(np.floor(number).astype(np.int64), 0, len(beats.times) - 1)
    in_bar = beats.bar_places[before] + number - before
    # Of three beats a bar, pairs go on across the bars.
    first = int(np.argmax(beats.bar_places == 0))
    in_pair = in_bar if beats.meter % 2 == 0 else number - first
    turns = np.stack([number, in_pair / 2, in_bar / beats.meter], axis=1) * 2 * np.pi
    return np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(len(at), 6)


def _tempo(beats: Beats, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Octaves above 120 beats a minute, by the median of nine beats around."""
    if len(beats.times) < 2:
        return np.zeros(len(at))
    # A median, so that a beat that was missed or added does not halve or double the tempo.
    steps = np.pad(np.diff(beats.times), 4, mode="edge")
    around = np.median(np.lib.stride_tricks.sliding_window_view(steps, 9), axis=1)
    middle = (beats.times[1:] + beats.times[:-1]) / 2
    return np.asarray(np.interp(at, middle, np.log2(0.5 / around)))


def _dynamics(
    power: NDArray[np.float32], at: NDArray[np.float64], fps: float
) -> tuple[NDArray[np.float64], float]:
    """[F, 7] of loudness by bands, onsets and changes, and the piece's range in units of 20 dB."""
    low, high = _SPLIT
    loudness = _decibels(power.sum(axis=1))
    lowest, median, highest = np.percentile(loudness, (5, 50, 95))
    # Everything is relative to the piece's own range, so neither gain nor compression counts.
    wide = max(highest - lowest, _SMALLEST_RANGE)
    parts = [loudness] + [_decibels(part.sum(axis=1)) for part in np.split(power, (low, high), axis=1)]
    columns = []
    for part in parts:  # against the median, in units of the piece's range
        quiet, usual, loud = np.percentile(part, (5, 50, 95))
        columns.append(np.clip((part - usual) / max(loud - quiet, _SMALLEST_RANGE), -2, 2))
    columns.append(_onsets(power))
    slow = _moving_mean(loudness, 2 * ROWS)
    columns.append(np.clip((slow - median) / wide, -2, 2))
    # Novelty: the loudness of the four seconds that follow less that of the four before.
    half = 2 * ROWS
    padded = np.pad(slow, half, mode="edge")
    columns.append(np.clip((padded[2 * half :] - padded[: -2 * half]) / wide, -2, 2))
    # Means over a frame, but of onsets the largest, so that none is missed.
    means = [_moving_mean(part, max(1, round(ROWS / fps))) for part in columns]
    rows = [np.interp(at * ROWS, np.arange(len(part)), part) for part in means]
    rows[4] = _peaks_at(columns[4], at, fps)
    return np.stack(rows, axis=1), float(min(wide / 20, 3.0))


def _balance(power: NDArray[np.float32]) -> tuple[float, float]:
    """Return brightness and bass of the piece, -1..1: shares of decibels above the silence."""
    mean = power.mean(axis=0)
    if mean.max() <= 0:
        return 0.0, 0.0
    shares = np.log10(mean / mean.max() + 1e-6) / 6 + 1
    low, high = _SPLIT
    middle = shares[low:high].mean()
    return float(shares[high:].mean() - middle), float(shares[:low].mean() - middle)


def _decibels(power: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return rows [T] in decibels above the silence of the piece, smoothed over a tenth of a second."""
    loudest = float(power.max(initial=0.0))
    if loudest <= 0:
        return np.zeros(len(power))
    return 10 * np.log10(_moving_mean(power / loudest, ROWS // 10) + _SILENCE)


def _onsets(power: NDArray[np.float32]) -> NDArray[np.float64]:
    """Rises over the bands [T], 1 what one row in fifty exceeds."""
    loudest = float(power.max(initial=0.0))
    if loudest <= 0:
        return np.zeros(len(power))
    # Only rises count: a note begins where power grows, in whichever bands, and ends without an onset.
    decibels = np.log10(power / loudest + _SILENCE)
    rise = np.maximum(np.diff(decibels, axis=0, prepend=decibels[:1]), 0).mean(axis=1)
    return np.asarray(np.clip(rise / max(float(np.percentile(rise, 98)), 1e-3), 0, 2))


def _moving_mean(values: NDArray[np.floating], width: int) -> NDArray[np.float64]:
    """Return means of the rows [T] around each, fewer at the ends."""
    # Differences of running sums: the cost does not depend on the width.
    sums = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    rows = np.arange(len(values))
    first = np.maximum(rows - width // 2, 0)
    last = np.minimum(rows + width // 2 + 1, len(values))
    return np.asarray((sums[last] - sums[first]) / (last - first))


def _peaks_at(values: NDArray[np.floating], at: NDArray[np.float64], fps: float) -> NDArray[np.float64]:
    """Rows [T] at seconds [F]: the largest within a frame, so that none is missed at few frames a second."""
    reach = max(1, round(ROWS / fps)) // 2
    padded = np.pad(values, reach, mode="edge")
    largest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return np.asarray(np.interp(at * ROWS, np.arange(len(largest)), largest))
