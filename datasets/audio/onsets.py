"""Onsets of music and the beats that librosa finds in them: its numbers, and nothing that numba compiles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.spectra import FFT, HOP, local_maxima

_BLOCK = 2048
"""Frames of tempograms made at a time: one is some 20 kB a frame. Blocks give the same numbers."""
_TEMPO_SECONDS = 8.0
"""Length of the windows that the tempo is measured in, as in `librosa.feature.tempo`."""
_USUAL, _FASTEST = 120.0, 320.0
"""Beats a minute."""
_TIGHT = 100.0
"""Cost of a beat that is early or late, for the square of its logarithm."""
_TINY = float(np.finfo(np.float32).tiny)


def decibels(power: NDArray[np.float32], reference: float = 1.0) -> NDArray[np.float32]:
    """Power in decibels, at least 80 below the loudest."""
    floor = 1e-10
    out = 10.0 * np.log10(np.maximum(floor, power)) - 10.0 * np.log10(np.maximum(floor, reference))
    return np.asarray(np.maximum(out, out.max() - 80.0), dtype=np.float32)


def onset_strength(mel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mel power [128, T] -> [T]: the median rise over the bands, moved to where windows are centred."""
    rise = np.median(np.maximum(0.0, np.diff(decibels(mel), axis=1)), axis=0)
    return np.pad(rise, (1 + FFT // (2 * HOP), 0))[: mel.shape[1]].astype(np.float32)


def tempogram(onsets: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Onset strengths [T] -> [width, T]: autocorrelation around each frame, the largest value 1."""
    return np.concatenate([block.astype(np.float32) for block in _tempograms(onsets, width)], axis=1)


def track_beats(onsets: NDArray[np.float32], rate: int) -> NDArray[np.int64]:
    """`librosa.beat.beat_track`: frames of the beats of onset strengths [T], ascending."""
    if not onsets.any():
        return np.empty(0, dtype=np.int64)
    width = int(_TEMPO_SECONDS * rate / HOP)
    mean = sum(block.sum(axis=1) for block in _tempograms(onsets, width)) / len(onsets)
    step = int(np.round(rate / HOP * 60.0 / _tempo(np.asarray(mean), rate)))
    window = np.exp(-0.5 * (np.arange(-step, step + 1) * 32.0 / max(1, step)) ** 2)
    scaled = onsets / (onsets.std(ddof=1) + _TINY)
    scaled[0] = 0  # librosa's sum leaves the first frame out
    score = np.convolve(scaled, window)[step : step + len(onsets)].astype(np.float32)
    before, total = _best_before(score, step)
    peaks = local_maxima(total)
    enough = peaks & (total >= 0.5 * np.median(total[peaks])) if peaks.any() else peaks
    at = int(np.flatnonzero(enough)[-1]) if enough.any() else len(onsets) - 1
    frames = []
    while at >= 0:
        frames.append(at)
        at = int(before[at])
    beats = np.array(frames[::-1])
    # Beats before the first and after the last frame that is loud enough are taken off.
    smooth = np.convolve(score[beats], np.hanning(5))[2 : len(score) + 2]
    loud = np.flatnonzero(score > 0.5 * np.sqrt(np.mean(np.square(smooth))))
    return np.asarray(beats[(beats >= loud[0]) & (beats <= loud[-1])])


def _best_before(score: NDArray[np.float32], step: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The best beat before one at each frame, -1 for none, and the score of the beats up to there."""
    # From the nearest on; of equals the nearest counts.
    away = np.arange(max(1, int(np.round(np.float32(step / 2)))), 2 * step + 1)
    cost = _TIGHT * (np.log(away) - np.log(max(1, step))) ** 2
    before = np.full(len(score), -1, dtype=np.int64)
    total = score.copy()
    begun = False
    for frame in range(len(score)):
        places = frame - away[: np.searchsorted(away, frame, side="right")]
        found = -1
        if len(places):
            gains = total[places] - cost[: len(places)]
            best = int(gains.argmax())
            found = int(places[best])
            total[frame] = score[frame] + gains[best]
        begun = begun or score[frame] >= 0.01 * score.max()
        before[frame] = found if begun else -1
    return before, total


def _tempo(mean: NDArray[np.float64], rate: int) -> float:
    """Beats a minute of a mean tempogram [width]: its strongest lag, at best one near 120."""
    with np.errstate(divide="ignore"):
        tempi = 60.0 * rate / (HOP * np.arange(len(mean)))
        likely = np.log1p(1e6 * mean) - 0.5 * np.log2(tempi / _USUAL) ** 2
    likely[: int(np.argmax(tempi < _FASTEST))] = -np.inf
    return float(tempi[int(likely.argmax())])


def _tempograms(onsets: NDArray[np.float32], width: int) -> Iterator[NDArray[np.float64]]:
    """[width, frames] of block after block."""
    from scipy.fft import irfft, next_fast_len, rfft

    # Onsets go on to both sides, fading, so that windows can be centred on the first and the last frame.
    padded = np.pad(onsets, width // 2, mode="linear_ramp", end_values=0)
    window = np.hanning(width + 1)[:-1]
    padding = next_fast_len(2 * width - 1, real=True)
    for start in range(0, len(onsets), _BLOCK):
        stop = min(start + _BLOCK, len(onsets))
        around = np.lib.stride_tricks.sliding_window_view(padded[start : stop + width - 1], width) * window
        power = np.square(np.abs(rfft(around, padding, axis=1)))
        product = irfft(power, padding, axis=1)[:, :width]
        largest = np.abs(product).max(axis=1, keepdims=True)
        largest[largest < _TINY] = 1
        yield (product / largest).T
