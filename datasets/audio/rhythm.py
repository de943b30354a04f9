"""Onset strength, tempogram, tempo, beats and onsets of a mel spectrogram, equal to librosa's.

librosa compiles its beat tracker with numba: 40 s when it is first used on a machine, 3 s in every process.
The same dynamic programming over whole arrays needs neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from motionloom.datasets.audio.spectrum import FFT, HOP

_BLOCK = 512
_FASTEST = 320.0
"""BPM; no tempo above it is considered."""

_TEMPO_SECONDS = 8.0
"""Length of the windows that the tempo is measured in."""


def onset_strength(level: NDArray[np.float32], aggregate: Literal["mean", "median"]) -> NDArray[np.float32]:
    """Mel levels [T, M] in dB -> [T]: the mean or median rise over the bands, moved to where it is heard."""
    rise = np.maximum(np.float32(0), level[1:] - level[:-1])
    strength = rise.mean(axis=1) if aggregate == "mean" else _median(rise)
    return np.pad(strength, (1 + FFT // (2 * HOP), 0))[: len(level)]


def tempogram(onsets: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """[T] -> [T, width]: autocorrelation of the Hann-weighted surroundings, the largest value 1."""
    out = np.empty((len(onsets), width), dtype=np.float32)
    for start, power, size in _spectra_around(onsets, width, np.float32):
        curves = fft.irfft(power, n=size, axis=1)[:, :width]
        energy = np.abs(curves).max(axis=1, keepdims=True)
        energy[energy < np.finfo(np.float32).tiny] = 1
        out[start : start + len(curves)] = curves / energy
    return out


def tempo(onsets: NDArray[np.float32], frames_per_second: float, start_bpm: float) -> float:
    """Beats a minute: the strongest period of the mean tempogram, weighted by nearness to `start_bpm`."""
    width = int(_TEMPO_SECONDS * frames_per_second)
    total, size = np.zeros(1), 1
    for _, power, size in _spectra_around(onsets, width, np.float64):
        # Transforms are linear: the mean curve is that of the mean spectrum, each scaled to energy 1.
        energy = (2 * power.sum(axis=1) - power[:, 0] - (power[:, -1] if size % 2 == 0 else 0)) / size
        energy[energy < np.finfo(np.float64).tiny] = 1
        total = total + (power / energy[:, None]).sum(axis=0)
    curve = fft.irfft(total / len(onsets), n=size)[:width]
    bpm = np.concatenate([[np.inf], 60 * frames_per_second / np.arange(1, width)])
    with np.errstate(divide="ignore"):
        prior = -0.5 * (np.log2(bpm) - np.log2(start_bpm)) ** 2
    prior[: int(np.argmax(bpm < _FASTEST))] = -np.inf
    return float(bpm[np.argmax(np.log1p(1e6 * curve) + prior)])


def track_beats(
    onsets: NDArray[np.float32], frames_per_second: float, *, start_bpm: float, tightness: float
) -> NDArray[np.int64]:
    """Frames of the beats, ascending: the path through strong onsets of nearly even steps."""
    if not onsets.any():
        return np.empty(0, dtype=np.int64)
    period = int(np.round(frames_per_second * 60 / tempo(onsets, frames_per_second, start_bpm)))
    spread = onsets.std(ddof=1) if len(onsets) > 1 else np.float32(0)
    even = (onsets / (spread + np.finfo(np.float32).tiny)).astype(np.float64)
    bell = np.exp(-0.5 * (np.arange(-period, period + 1) * 32.0 / period) ** 2)
    even[0] = 0  # librosa's sum leaves the first frame out
    score = np.convolve(even, bell)[period : period + len(even)]
    previous, total = _best_paths(score, period, tightness)
    beats = np.zeros(len(score), dtype=bool)
    at = _last_beat(total)
    while at >= 0:
        beats[at] = True
        at = previous[at]
    smooth = np.convolve(score[beats], np.hanning(5))[2 : len(score) + 2]
    strong = np.flatnonzero(score > 0.5 * np.sqrt((smooth**2).mean()))
    found = np.flatnonzero(beats)
    return found[(found >= strong[0]) & (found <= strong[-1])] if len(strong) else found[:0]


def pick_onsets(onsets: NDArray[np.float32], frames_per_second: float) -> NDArray[np.int64]:
    """Frames of note onsets: maxima of 30 ms that stand 7 % of the range above the mean of 200 ms."""
    values = onsets - onsets.min()
    values /= values.max() + np.finfo(np.float32).tiny
    rate = frames_per_second * HOP  # librosa rounds down in samples
    near, far = int(0.03 * rate // HOP), int(0.10 * rate // HOP)
    picked: list[int] = []
    at = 0
    while at < len(values) and values.any():
        highest = values[at] >= values[max(0, at - near) : at + 1].max()
        mean = values[max(0, at - far) : at + far + 1].mean()
        if highest and values[at] >= mean + 0.07:
            picked.append(at)
            at += near
        at += 1
    return np.asarray(picked, dtype=np.int64)


def _best_paths(
    score: NDArray[np.float64], period: int, tightness: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For a beat at each frame: the best beat before it (-1: none) and the score of the path up to it."""
    shortest, longest = max(1, int(np.round(period / 2))), 2 * period
    penalty = tightness * (np.log(np.arange(shortest, longest + 1)) - np.log(period)) ** 2
    # Totals backwards in time, `longest` frames of none first: candidates of nearest beats come first, as
    # ties go to the nearest. Frames closer than the shortest step do not depend on each other: one block.
    total = np.full(longest + len(score), -np.inf)
    previous = np.full(len(score), -1, dtype=np.int64)
    candidates = np.lib.stride_tricks.sliding_window_view(total, len(penalty))[:, ::-1]
    for start in range(0, len(score), shortest):
        part = score[start : start + shortest]
        before = candidates[start : start + len(part)] - penalty
        best = before.argmax(axis=1)
        gain = before[np.arange(len(part)), best]
        found = gain > -np.inf
        total[longest + start : longest + start + len(part)] = part + np.where(found, gain, 0)
        previous[start : start + len(part)] = np.where(
            found, np.arange(start, start + len(part)) - shortest - best, -1
        )
    begun = score >= 0.01 * score.max()
    previous[: int(np.argmax(begun))] = -1  # nothing counts as a beat before the first sound
    return previous, total[longest:]


def _last_beat(total: NDArray[np.float64]) -> int:
    """The last local maximum that reaches half the median of all of them."""
    peak = np.zeros(len(total), dtype=bool)
    peak[1:-1] = (total[1:-1] > total[:-2]) & (total[1:-1] >= total[2:])
    peak[-1] = len(total) > 1 and total[-1] > total[-2]
    if not peak.any():
        return len(total) - 1
    return int(np.flatnonzero(peak & (total >= 0.5 * np.median(total[peak])))[-1])


def _spectra_around(
    onsets: NDArray[np.float32], width: int, dtype: type
) -> Iterator[tuple[int, NDArray, int]]:
    """(first frame, power spectra [frames, F], transform size) of the weighted surroundings of each frame."""
    padded = np.pad(onsets, width // 2, mode="linear_ramp", end_values=0)
    frames = np.lib.stride_tricks.sliding_window_view(padded, width)[: len(onsets)]
    weight: NDArray = (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(width) / width)).astype(dtype)
    size = fft.next_fast_len(2 * width - 1, real=True)
    for start in range(0, len(frames), _BLOCK):
        spectrum = fft.rfft(frames[start : start + _BLOCK] * weight, n=size, axis=1)
        yield start, spectrum.real**2 + spectrum.imag**2, size


def _median(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Median of an even number of columns, [T, 2k] -> [T]."""
    half = values.shape[1] // 2
    ordered = np.partition(values, (half - 1, half), axis=1)
    return np.asarray(ordered[:, half - 1 : half + 1].mean(axis=1))
