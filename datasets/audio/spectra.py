"""Spectra of a sound: mel power, harmonic and percussive shares, tuning, with the numbers of librosa.

Of librosa only `filters` is imported: what numba compiles of it takes half a minute where it is first used.

- The medians of harmonic-percussive separation run along rows of one long line. scipy does that ten times as
  fast as the two-dimensional filters that `librosa.effects.hpss` calls, with the same numbers. One transform
  serves mel power and separation.
- A long sound is taken in pieces, with margins that hold every frame that medians and windows reach. Spectra
  of an hour need no more memory than those of half a minute, and no seam shows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
FFT = 2048
HOP = 512
MELS = 128

_MEDIAN = 31
_MARGIN = 32
"""Frames beside a piece: 15 for medians, 2 each for the windows there, back and there again, and to spare."""

_PIECE = 2048
"""Frames of a piece without its margins; some 100 MB are used at once."""
_PITCHES = (150.0, 4000.0)
"""Hz between which the tuning is heard."""
_FAINT = 0.1
"""Magnitude against a frame's loudest, below which a peak is no pitch."""
_TINY = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True)
class Spectra:
    """A sound of T frames, taken apart."""

    mel: Array
    """Mel power [128, T]."""
    percussive_mel: Array
    """Mel power of the percussive share [128, T]."""
    harmonic: Array
    """The harmonic share, samples [n]."""


@dataclass(frozen=True)
class _Piece:
    """Some frames of a sound and what lies around them."""

    samples: Array
    """Margins included."""
    frames: slice
    """Frames of the sound, without margins."""
    inside: slice
    """The same frames, counted from the first of the piece."""


def stft(samples: Array, window: Array, hop: int) -> NDArray[np.complex64]:
    """Samples [n] -> spectra [1 + width // 2, 1 + n // hop] of windows centred at multiples of `hop`."""
    from scipy.fft import rfft

    padded = np.pad(samples, len(window) // 2)
    frames = np.lib.stride_tricks.sliding_window_view(padded, len(window))[::hop]
    return np.asarray(rfft(frames * window, axis=1).T)


def hann() -> Array:
    """The periodic window of `FFT` samples."""
    return np.hanning(FFT + 1)[:-1].astype(np.float32)


def separate(samples: Array, rate: int) -> Spectra:
    """Mono samples [n] -> mel power and shares of T = 1 + n // 512 frames."""
    count = 1 + len(samples) // HOP
    mel, percussive_mel = np.empty((2, MELS, count), dtype=np.float32)
    harmonic = np.empty(count * HOP, dtype=np.float32)
    for piece in _pieces(samples):
        spectrum = stft(piece.samples, hann(), HOP)
        magnitude = np.abs(spectrum)
        mel[:, piece.frames] = _mel(magnitude, rate)[:, piece.inside]
        # Notes are steady along time and percussion along frequency: medians each way tell them apart.
        steady = _row_medians(magnitude)
        sudden = _row_medians(magnitude.T).T
        soft = _softmask(steady, sudden)
        shares = [_istft(spectrum * mask, len(piece.samples)) for mask in (soft, 1 - soft)]
        own = shares[0][piece.inside.start * HOP : piece.inside.stop * HOP]
        harmonic[piece.frames.start * HOP :][: len(own)] = own
        percussive_mel[:, piece.frames] = _mel(_magnitude(shares[1]), rate)[:, piece.inside]
    return Spectra(mel, percussive_mel, harmonic[: len(samples)])


def tuning(samples: Array, rate: int, bins: int) -> float:
    """`librosa.estimate_tuning`: how far the music is from A = 440 Hz, in bins (`bins` an octave)."""
    found = [_pitches(_magnitude(piece.samples)[:, piece.inside], rate) for piece in _pieces(samples)]
    pitch, height = (np.concatenate(part) for part in zip(*found, strict=True))
    if not len(pitch):
        return 0.0
    octaves = np.log2(pitch[height >= np.median(height)] / 27.5)
    away = np.mod(bins * octaves, 1.0)
    away[away >= 0.5] -= 1.0
    counts, edges = np.histogram(away, np.linspace(-0.5, 0.5, 101))
    return float(edges[np.argmax(counts)])


def local_maxima(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """[N, ...]: whether each is above the one before it and not below the next; the first is none."""
    out = np.zeros(values.shape, dtype=np.bool_)
    out[1:] = values[1:] > values[:-1]
    out[1:-1] &= values[1:-1] >= values[2:]
    return out


def _pitches(magnitude: Array, rate: int) -> tuple[Array, Array]:
    """`librosa.piptrack`: pitches in Hz and magnitudes of the peaks of [F, T], each between its rows."""
    shift = np.zeros_like(magnitude)
    curve = magnitude[2:] + magnitude[:-2] - 2 * magnitude[1:-1]
    slope = (magnitude[2:] - magnitude[:-2]) / 2
    near = np.abs(slope) < np.abs(curve)
    np.divide(-slope, curve, out=shift[1:-1], where=near)
    hertz = np.arange(len(magnitude)) * (rate / FFT)
    low, high = _PITCHES
    heard = (low <= hertz) & (hertz < min(high, rate / 2))
    loud = magnitude > _FAINT * magnitude.max(axis=0)
    at = np.nonzero(heard[:, None] & local_maxima(magnitude * loud))
    heights = magnitude[at] + 0.5 * np.gradient(magnitude, axis=0)[at] * shift[at]
    pitches = ((at[0] + shift[at]) * float(rate) / FFT).astype(np.float32)
    return pitches[pitches > 0], heights[pitches > 0]


def _softmask(own: Array, other: Array) -> Array:
    """Share of `own` in both by their squares; a half where both are 0."""
    largest = np.maximum(own, other)
    silent = largest < _TINY
    largest[silent] = 1
    power = np.square(own / largest)
    mask = np.full_like(own, 0.5)
    np.divide(power, power + np.square(other / largest), out=mask, where=~silent)
    return mask


def _istft(spectrum: NDArray[np.complex64], length: int) -> Array:
    """Samples [length] of spectra [1025, T], each frame windowed again and weighted by all windows."""
    from scipy.fft import irfft

    window = hann()
    frames = irfft(spectrum.T, FFT, axis=1) * window
    total, weight = np.zeros((2, (len(frames) + FFT // HOP) * HOP), dtype=np.float32)
    for start in range(0, FFT, HOP):
        part = slice(start, start + len(frames) * HOP)
        total[part] += frames[:, start : start + HOP].ravel()
        weight[part] += np.tile(np.square(window[start : start + HOP]), len(frames))
    np.divide(total, weight, out=total, where=weight > _TINY)
    out = total[FFT // 2 : FFT // 2 + length]
    return np.pad(out, (0, length - len(out)))


def _pieces(samples: Array) -> Iterator[_Piece]:
    count = 1 + len(samples) // HOP
    for start in range(0, count, _PIECE):
        stop = min(start + _PIECE, count)
        # The last piece takes the rest as it is.
        first = max(0, start - _MARGIN)
        last = stop + _MARGIN
        around = samples[first * HOP :] if last >= count else samples[first * HOP : (last - 1) * HOP]
        yield _Piece(around, slice(start, stop), slice(start - first, stop - first))


def _magnitude(samples: Array) -> Array:
    return np.abs(stft(samples, hann(), HOP))


def _mel(magnitude: Array, rate: int) -> Array:
    return np.asarray(_mel_filters(rate) @ np.square(magnitude), dtype=np.float32)


@lru_cache(maxsize=4)
def _mel_filters(rate: int) -> Array:
    from librosa.filters import mel

    return np.asarray(mel(sr=rate, n_fft=FFT, n_mels=MELS))


def _row_medians(values: Array) -> Array:
    """[N, M] -> [N, M]: running medians of 31 along each row, the ends continued by reflection."""
    from scipy.ndimage import median_filter

    reach = _MEDIAN // 2
    padded = np.pad(values, ((0, 0), (reach, reach)), mode="symmetric")  # rows cannot reach each other
    return np.asarray(median_filter(padded.ravel(), _MEDIAN).reshape(padded.shape)[:, reach:-reach])
