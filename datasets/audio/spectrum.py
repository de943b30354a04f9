"""Short-time spectra as librosa makes them: frames of 2048 samples, Hann, hop 512, zeros around the ends.

Everything runs in blocks of frames, so memory beyond the sound itself does not grow with its length.

Notable choices:
- Transforms that decibels are taken of run in float64 (librosa's do, through its float64 window): float32
  noise would show in quiet bands. The way back to sound runs in float32, as librosa's does.
- One transform serves MFCC and separation; librosa computes it once for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from motionloom.datasets.audio.median import REACH, running_median, running_median_valid

FFT = 2048
HOP = 512
MELS = 128
_BLOCK = 256
"""Frames worked on at once."""

_OVERLAP = FFT // HOP
_TINY = np.finfo(np.float32).tiny


def frame_count(samples: int) -> int:
    """Frames of a sound of `samples` samples: one at every 512, and one more."""
    return 1 + samples // HOP


def window() -> NDArray[np.float64]:
    """The periodic Hann window, [2048]."""
    return np.asarray(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(FFT) / FFT))


def spectra(
    samples: NDArray[np.float32], *, reach: int = 0, exact: bool = True
) -> Iterator[tuple[int, int, NDArray[np.complex64]]]:
    """(first frame, last + 1, spectra [frames, 1025]) of block after block.

    With `reach`, up to so many frames of the neighbouring blocks come along on either side. Transforms that
    are not `exact` run in float32.
    """
    padded = np.pad(samples, FFT // 2)
    frames = np.lib.stride_tricks.sliding_window_view(padded, FFT)[::HOP]
    shape = window() if exact else window().astype(np.float32)
    for start in range(0, len(frames), _BLOCK):
        stop = min(start + _BLOCK, len(frames))
        part = frames[max(0, start - reach) : stop + reach]
        yield start, stop, fft.rfft(part * shape, axis=1).astype(np.complex64, copy=False)


def mel_power(magnitude: NDArray[np.float32], rate: int) -> NDArray[np.float32]:
    """Magnitudes [T, 1025] -> power in 128 mel bands [T, 128]."""
    return np.asarray((magnitude * magnitude) @ mel_bands(rate))


def decibels(power: NDArray[np.float32], loudest: bool) -> NDArray[np.float32]:
    """Power -> dB against 1, or against the loudest value; at most 80 dB below the maximum."""
    level = 10 * np.log10(np.maximum(np.float32(1e-10), power))
    if loudest:
        level -= 10 * np.log10(np.maximum(np.float32(1e-10), power.max()))
    return np.asarray(np.maximum(level, level.max() - np.float32(80)))


@lru_cache(maxsize=8)
def mel_bands(rate: int) -> NDArray[np.float32]:
    """Weights [1025, 128]: triangles equally spaced on Slaney's mel scale, each of unit area."""
    knee, step = 15.0, np.log(6.4) / 27  # below 1000 Hz 3 mel are 200 Hz; above it is logarithmic
    top = rate / 2
    highest = knee + np.log(top / 1000) / step if top >= 1000 else top * 3 / 200
    mels = np.linspace(0, highest, MELS + 2)
    edges = np.where(mels < knee, mels * 200 / 3, 1000 * np.exp(step * (mels - knee)))
    bins = np.arange(1 + FFT // 2) * rate / FFT
    rising = (bins[:, None] - edges[:-2]) / (edges[1:-1] - edges[:-2])
    falling = (edges[2:] - bins[:, None]) / (edges[2:] - edges[1:-1])
    triangles = np.maximum(0, np.minimum(rising, falling)) * (2 / (edges[2:] - edges[:-2]))
    return np.asarray(triangles, dtype=np.float32)


class Separation:
    """Harmonic-percussive separation by medians over 31 frames and 31 bins; blocks in, two sounds out."""

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._frames = frame_count(samples)
        self._sums = np.zeros((2, self._frames + _OVERLAP - 1, HOP), dtype=np.float32)
        self._window = window().astype(np.float32)

    def add(
        self, start: int, stop: int, spectra: NDArray[np.complex64], magnitude: NDArray[np.float32]
    ) -> None:
        """Frames start .. stop - 1, with up to 15 neighbours on either side in both arrays."""
        before = start - max(0, start - REACH)
        own = slice(before, before + stop - start)
        missing = (REACH - before, REACH - (len(magnitude) - own.stop))
        harmonic = running_median_valid(np.pad(magnitude, (missing, (0, 0)), mode="symmetric"))
        percussive = running_median(np.ascontiguousarray(magnitude[own].T)).T
        masks = _shares(harmonic, np.ascontiguousarray(percussive))
        for sums, mask in zip(self._sums, masks, strict=True):
            frames = fft.irfft(spectra[own] * mask, n=FFT, axis=1)
            frames *= self._window
            for part in reversed(range(_OVERLAP)):  # the frames that began first are added first
                sums[start + part : stop + part] += frames[:, part * HOP : (part + 1) * HOP]

    def sounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(harmonic, percussive) samples [n] once every frame has been added."""
        squares = (self._window**2).reshape(_OVERLAP, HOP)
        weight = np.zeros(self._sums.shape[1:], dtype=np.float32)
        for part in range(_OVERLAP):
            weight[part : part + self._frames] += squares[part]
        weight[weight <= _TINY] = 1
        inside = slice(FFT // 2, FFT // 2 + self._samples)
        self._sums /= weight
        harmonic, percussive = self._sums.reshape(2, -1)[:, inside]
        return harmonic, percussive


def _shares(first: NDArray[np.float32], second: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """Shares first^2 / (first^2 + second^2) and the rest; a half each where both are 0. Inputs are reused."""
    larger = np.maximum(first, second)
    nothing = larger < _TINY
    larger[nothing] = 1
    for values in (first, second):
        values /= larger  # the squares of quiet sound would underflow
        values *= values
    np.add(first, second, out=larger)
    larger[nothing] = 1
    first /= larger
    second /= larger
    first[nothing] = second[nothing] = 0.5
    return first, second
