"""Power of a sound in 64 bands, 60 rows a second: what beats are heard in, without an import of librosa.

Row t is centred at t / 60 s. Bands are triangles, evenly spaced in mel from 30 Hz to 14 kHz, which every
recording has something of. Long sounds are taken block by block.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import Sound

BANDS = 64
ROWS = 60
"""Rows a second."""
RATE = 30720
"""Sample rate that spectra are computed at, Hz."""

_HOP = RATE // ROWS
_FFT = 2048
_EDGES = (30.0, 14_000.0)
_BLOCK = 2048


def band_power(sound: Sound) -> NDArray[np.float32]:
    """A sound -> float32 [1 + n // 512, 64], n its samples at 30720 Hz."""
    from scipy.fft import rfft

    samples = np.pad(sound.resampled(RATE).samples, _FFT // 2)
    frames = np.lib.stride_tricks.sliding_window_view(samples, _FFT)[::_HOP]
    window = np.hanning(_FFT + 1)[:-1].astype(np.float32)
    blocks = []
    for start in range(0, len(frames), _BLOCK):
        spectrum = np.abs(rfft(frames[start : start + _BLOCK] * window, axis=1))
        blocks.append(spectrum**2 @ _filters())
    return np.concatenate(blocks)


def band_from(hertz: float) -> int:
    """Number of the first band whose centre is at or above a frequency."""
    return int(np.searchsorted(_centres()[1:-1], hertz))


def _centres() -> NDArray[np.float64]:
    """[66] Hz: the centres of the bands, and a point to each side of them."""
    low, high = (np.log1p(hertz / 700) for hertz in _EDGES)
    return np.asarray(700 * np.expm1(np.linspace(low, high, BANDS + 2)))


@lru_cache(maxsize=1)
def _filters() -> NDArray[np.float32]:
    """[1025, 64]: each band rises from the centre of the one below to its own and falls to the next."""
    hertz = np.fft.rfftfreq(_FFT, 1 / RATE)[:, None]
    points = _centres()
    below, centre, above = points[:-2], points[1:-1], points[2:]
    shape = np.minimum((hertz - below) / (centre - below), (above - hertz) / (above - centre))
    return np.maximum(shape, 0).astype(np.float32)
