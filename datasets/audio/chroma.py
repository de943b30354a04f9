"""Twelve-note chroma of a constant-Q transform, as librosa's `chroma_cqt` (36 bins an octave from C1).

The transform goes down the octaves on a sound that is halved each time. With frequency and rate halved
together every octave has the same filters, so 36 of them serve all. librosa makes them anew for each octave
and multiplies their sparse spectra with an FFT of every frame; here the same sparse spectra are brought back
to the time domain once, and an octave is one matrix product.

Frames 140 dB below the loudest one have no notes: what is there is rounding, which librosa scales up to 1.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from motionloom.datasets.audio.sound import resample_sound
from motionloom.datasets.audio.spectrum import FFT, HOP

NOTES = 12
BINS = 36
"""Bins an octave."""

LOWEST = 440.0 * 2.0 ** ((24 - 69) / 12)
"""C1, in Hz."""

_HANN_BANDWIDTH = 1.50018310546875
_DROPPED = 0.01
"""The share of each filter's spectrum, smallest values first, that is set to zero."""

_ALPHA = (2.0 ** (2 / BINS) - 1) / (2.0 ** (2 / BINS) + 1)
"""Bandwidth of a filter over its frequency."""

_HOP_HALVINGS = 9
"""A hop of 512 samples can be halved nine times."""

_NOTE_OF_BIN = (((np.arange(BINS) + 1) // 3 % NOTES)[:, None] == np.arange(NOTES)).astype(np.float32)
"""[36, 12]: the three bins around a note are its own."""

_SILENCE = np.float32(1e-7)
_BLOCK = 128


def fitting_octaves(rate: int, most: int = 7) -> int:
    """As many octaves above C1 as fit below half the rate, at most `most`; 0 where not even one does."""
    for octaves in range(most, 0, -1):
        if _highest(octaves) <= rate / 2:
            return octaves
    return 0


class Tuning:
    """How far the music is from A = 440 Hz, in bins, from spectral peaks between 150 and 4000 Hz."""

    def __init__(self, rate: int) -> None:
        self._bin = rate / FFT
        frequencies = np.arange(1 + FFT // 2) * self._bin
        chosen = np.flatnonzero((frequencies >= 150.0) & (frequencies < min(4000.0, rate / 2)))
        self._first, self._last = int(chosen[0]), int(chosen[-1])
        self._pitches: list[NDArray] = []
        self._heights: list[NDArray] = []

    def add(self, magnitude: NDArray[np.float32]) -> None:
        """Magnitudes [T, 1025] of some frames."""
        low, high = self._first, self._last + 1
        here, left, right = (magnitude[:, low + d : high + d] for d in (0, -1, 1))
        loud = np.float32(0.1) * magnitude.max(axis=1, keepdims=True)
        at = np.nonzero((here > left) & (here >= right) & (here > loud))
        top, before, after = here[at], left[at], right[at]
        bend, slope = after + before - 2 * top, (after - before) / 2
        flat = np.abs(slope) >= np.abs(bend)  # the parabola's top would be more than a bin away
        shift = np.where(flat, 0, -slope / np.where(flat, 1, bend)).astype(np.float32)
        self._pitches.append(((at[1] + low + shift) * self._bin).astype(np.float32))
        self._heights.append(top + np.float32(0.5) * slope * shift)

    def estimate(self) -> float:
        """Bins, -0.5 .. 0.49 in steps of 0.01: the commonest deviation among the higher half of the peaks."""
        pitches, heights = np.concatenate(self._pitches), np.concatenate(self._heights)
        if not len(pitches):
            return 0.0
        pitches = pitches[heights >= np.median(heights)]
        deviation = np.mod(BINS * np.log2(pitches / (440.0 / 16)), 1.0)
        deviation[deviation >= 0.5] -= 1.0
        counts, edges = np.histogram(deviation, np.linspace(-0.5, 0.5, 101))
        return float(edges[np.argmax(counts)])


def chroma(samples: NDArray[np.float32], rate: int, octaves: int, tuning: float) -> NDArray[np.float32]:
    """Samples [n] -> energy of the twelve notes from C, [T, 12], not normalized.

    Raises ValueError when the highest octave does not fit below half the rate.
    """
    if _highest(octaves) > rate / 2:
        raise ValueError(f"{octaves} octaves above C1 do not fit below {rate / 2:g} Hz")
    halvings = max(0, int(np.ceil(np.log2(rate / 2 / _highest(octaves, tuning)))) - 2)
    hop, frames = HOP, 1 + len(samples) // HOP
    if halvings := min(halvings, _HOP_HALVINGS - octaves + 1):
        samples, hop = _slower(samples, 2**halvings), HOP >> halvings
    filters = _filters(rate / 2**halvings, octaves, tuning)
    out = np.zeros((frames, NOTES), dtype=np.float32)
    for octave in range(octaves):
        if octave:
            samples, hop = _slower(samples, 2), hop // 2
        count = 1 + len(samples) // hop
        frames = min(frames, count)
        for start in range(0, frames, _BLOCK):
            stop = min(start + _BLOCK, frames)
            out[start:stop] += _strengths(samples, hop, start, stop, filters) @ _NOTE_OF_BIN
    loudest = out.max(axis=1, keepdims=True)
    return np.where(loudest < _SILENCE * loudest.max(), np.float32(0), out)[:frames]


def normalized(values: NDArray[np.float32], norm: float) -> NDArray[np.float32]:
    """Rows [T, D] divided by their norm (1, 2 or infinity); rows of nothing stay as they are."""
    length = np.linalg.norm(values.astype(np.float64), ord=norm, axis=1, keepdims=True)
    length[length < np.finfo(np.float32).tiny] = 1
    return np.asarray(values / length, dtype=np.float32)


def _highest(octaves: int, tuning: float = 0.5) -> float:
    """Upper edge of the highest filter's main lobe, Hz (0.5: the sharpest tuning)."""
    top = LOWEST * 2.0 ** (octaves - 1 / BINS + tuning / BINS)
    return float(top * (1 + 0.5 * _HANN_BANDWIDTH * _ALPHA))


def _slower(samples: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Every `factor`-th sample after a low-pass filter, scaled so that the energy stays."""
    return resample_sound(samples, factor, 1) * np.float32(np.sqrt(factor))


def _strengths(
    samples: NDArray[np.float32], hop: int, start: int, stop: int, filters: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Magnitudes [stop - start, 36] of the frames centred on `hop` x (start .. stop - 1)."""
    width = len(filters)
    begin, end = start * hop - width // 2, (stop - 1) * hop + width // 2
    part = np.pad(samples[max(0, begin) : end], (max(0, -begin), max(0, end - max(len(samples), begin))))
    frames = np.lib.stride_tricks.sliding_window_view(part, width)[::hop]
    both = np.ascontiguousarray(frames) @ filters
    return np.asarray(np.hypot(both[:, :BINS], both[:, BINS:]))


@lru_cache(maxsize=64)
def _filters(rate: float, octaves: int, tuning: float) -> NDArray[np.float32]:
    """Filters [width, 2 x 36] of the highest octave: real parts, then imaginary parts."""
    notes = LOWEST * 2.0 ** ((BINS * (octaves - 1) + np.arange(BINS) + tuning) / BINS)
    lengths = rate / notes / _ALPHA
    width = 2 ** int(np.ceil(np.log2(lengths.max())))
    waves = np.zeros((BINS, width), dtype=np.complex128)
    for i, (note, length) in enumerate(zip(notes, lengths, strict=True)):
        at = np.arange(np.floor(-length / 2), np.floor(length / 2))
        wave = (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(len(at)) / len(at))).astype(np.complex128)
        wave *= np.exp(2j * np.pi * note / rate * at)
        first = (width - len(wave)) // 2
        waves[i, first : first + len(wave)] = wave / np.abs(wave).sum() * length / width
    half = fft.fft(waves, axis=1)[:, : width // 2 + 1]
    sizes = np.abs(half)
    ordered = np.sort(sizes, axis=1)
    cumulative = np.cumsum(ordered, axis=1) / ordered.sum(axis=1, keepdims=True)
    smallest = ordered[np.arange(BINS), np.argmin(cumulative < _DROPPED, axis=1)]
    half[sizes < smallest[:, None]] = 0
    back = fft.fft(half, n=width, axis=1) / np.sqrt(lengths)[:, None]
    return np.ascontiguousarray(np.concatenate([back.real, back.imag]).T, dtype=np.float32)
