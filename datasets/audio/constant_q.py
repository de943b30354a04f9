"""Constant-Q spectra, as `librosa.cqt`: filters of three semitones' thirds, octave by octave.

Each octave's filters are those of the highest, on the sound at half the rate of the octave above.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import resample_sound
from motionloom.datasets.audio.spectra import HOP, stft, tuning

BINS = 36
"""Bins an octave."""
_LOWEST = 440.0 * 2.0 ** (-45 / 12)
"""Hz of C1."""
_SPARSE = 0.01
"""Share of a filter's spectrum that is left out, where it is smallest."""


def fitting_octaves(rate: int) -> int:
    """Return how many octaves above C1 fit below half the rate, at most 7; 0 where not even one does."""
    for octaves in range(7, 0, -1):
        # Tuning moves the filters by less than half a bin.
        if _lengths(_frequencies(octaves, 0.5), rate)[1] <= rate / 2:
            return octaves
    return 0


def constant_q(samples: NDArray[np.float32], rate: int, octaves: int) -> NDArray[np.float32]:
    """Magnitudes [36 x octaves, 1 + n // 512] from C1 up, in the tuning of the sound."""
    frequencies = _frequencies(octaves, tuning(samples, rate, BINS))
    # A sound with room above the highest filter is first brought down; frames must begin at whole samples.
    room = int(np.ceil(np.log2(rate / 2 / _lengths(frequencies, rate)[1]))) - 2
    down = 2 ** max(0, min(room, 10 - octaves))
    samples = _slower(samples, down)
    hop = HOP // down
    top = rate / down
    lengths = _lengths(frequencies, top)[0]
    own = top
    parts = []
    for octave in range(octaves - 1, -1, -1):
        part = slice(octave * BINS, (octave + 1) * BINS)
        basis = _basis(frequencies[part], lengths[part] * own / top, own) * np.float32(np.sqrt(top / own))
        parts.append(basis @ stft(samples, np.ones(2 * basis.shape[1] - 2, dtype=np.float32), hop))
        if hop % 2 == 0:
            samples = _slower(samples, 2)
            hop = hop // 2
            own = own / 2
    frames = min(part.shape[1] for part in parts)
    spectrum = np.concatenate([part[:, :frames] for part in reversed(parts)])
    return np.asarray(np.abs(spectrum) / np.sqrt(lengths)[:, None], dtype=np.float32)


def chroma(magnitudes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums of [36 x octaves, T] by their notes [12, T], from C up, of each frame the strongest 1."""
    # A note's three bins are a third of a semitone below it, on it, and above; the first bin is on C.
    octaves = len(magnitudes) // BINS
    around = np.roll(magnitudes, 1, axis=0).reshape(octaves, 12, BINS // 12, -1)
    notes = around.sum(axis=(0, 2))
    strongest = notes.max(axis=0)
    strongest[strongest < np.finfo(np.float32).tiny] = 1
    return np.asarray(notes / strongest, dtype=np.float32)


def _frequencies(octaves: int, tuned: float) -> NDArray[np.float64]:
    return np.asarray(_LOWEST * 2.0 ** ((tuned + np.arange(octaves * BINS)) / BINS))


def _lengths(frequencies: NDArray[np.float64], rate: float) -> tuple[NDArray[np.float64], float]:
    """Samples of the filters, and the highest frequency that they reach."""
    from librosa.filters import wavelet_lengths

    lengths, highest = wavelet_lengths(freqs=frequencies, sr=rate)
    return np.asarray(lengths), float(highest)


def _basis(frequencies: NDArray[np.float64], lengths: NDArray[np.float64], rate: float) -> Any:
    """Spectra of the filters, sparse [36, 1 + width // 2]."""
    from scipy.fft import fft
    from scipy.signal import get_window
    from scipy.sparse import csr_matrix

    width = int(2.0 ** np.ceil(np.log2(lengths.max())))
    filters = np.zeros((len(frequencies), width), dtype=np.complex64)
    for row, (length, hertz) in enumerate(zip(lengths, frequencies, strict=True)):
        at = np.arange(-length // 2, length // 2)
        wave = np.exp(2j * np.pi * hertz / rate * at) * get_window("hann", len(at))
        begin = (width - len(at)) // 2
        filters[row, begin : begin + len(at)] = wave / np.abs(wave).sum()
    filters *= lengths[:, None] / float(width)
    spectra = fft(filters, axis=1)[:, : width // 2 + 1]
    sizes = np.abs(spectra)
    ordered = np.sort(sizes, axis=1)
    least = np.argmin(np.cumsum(ordered / sizes.sum(axis=1, keepdims=True), axis=1) < _SPARSE, axis=1)
    spectra[sizes < np.take_along_axis(ordered, least[:, None], axis=1)] = 0
    return csr_matrix(spectra)


def _slower(samples: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """At a lower rate, of the same energy."""
    return samples if factor == 1 else resample_sound(samples, factor, 1) * np.float32(np.sqrt(factor))
