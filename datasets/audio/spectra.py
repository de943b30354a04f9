"""Spectra of a sound: mel power, harmonic and percussive shares, tuning.

Everything is librosa's; three things are arranged here:

- librosa compiles parts of itself with numba: half a minute when it is first used in an environment, then
  seconds in each process. Processes that fill one cache of numba's at once can mix their files and crash
  (numba issue 10128), which the workers of a first conversion would do. So the first process compiles all
  that audio features use behind a lock and leaves a mark; whoever finds the mark just imports.

- The medians of harmonic-percussive separation run along rows of one long line. scipy does that ten times as
  fast as the two-dimensional filters that `librosa.effects.hpss` calls, with the same numbers. One transform
  serves mel power and separation.
- A long sound is taken in pieces, with margins that hold every frame that medians and windows reach. Spectra
  of an hour need no more memory than those of half a minute, and no seam shows.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import distribution, version
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

FFT = 2048
HOP = 512
MELS = 128

_MEDIAN = 31
_MARGIN = 32
"""Frames beside a piece: 15 for medians, 2 each for the windows there, back and there again, and to spare."""

_PIECE = 2048
"""Frames of a piece without its margins; some 100 MB are used at once."""


@lru_cache(maxsize=1)
def load_librosa() -> Any:
    """The module, with what audio features use of it compiled."""
    mark = _mark()
    if mark.exists():
        return _imported()
    with mark.with_suffix(".lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        module = _imported()
        mark.touch()
    return module


def _mark() -> Path:
    """The file whose existence means that numba's cache of this installation and processor is filled."""
    package = distribution("librosa")
    from llvmlite.binding import get_host_cpu_name  # numba's own name of it

    source = Path(str(package.locate_file("librosa/__init__.py")))
    about = f"{source} {source.stat().st_mtime_ns} {version('numba')} {get_host_cpu_name()}"
    own = Path(tempfile.gettempdir()) / f"motionloom-{os.getuid()}"
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", own))
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"motionloom-librosa-{crc32(about.encode()):08x}.compiled"


def _imported() -> Any:
    import librosa
    import librosa.beat  # compiles on import, like most of librosa; the calls below do the rest

    noise = np.random.default_rng(0).standard_normal(4096).astype(np.float32)
    librosa.istft(librosa.stft(noise))
    librosa.cqt(noise, sr=4096, n_bins=12, fmin=440.0)
    return librosa


@dataclass(frozen=True)
class Spectra:
    """A sound of T frames, taken apart."""

    mel: NDArray[np.float32]
    """Mel power [128, T]."""
    percussive_mel: NDArray[np.float32]
    """Mel power of the percussive share [128, T]."""
    harmonic: NDArray[np.float32]
    """The harmonic share, samples [n]."""


@dataclass(frozen=True)
class _Piece:
    """Some frames of a sound and what lies around them."""

    samples: NDArray[np.float32]
    """Margins included."""
    frames: slice
    """Frames of the sound, without margins."""
    inside: slice
    """The same frames, counted from the first of the piece."""


def separate(samples: NDArray[np.float32], rate: int) -> Spectra:
    """Mono samples [n] -> mel power and shares of T = 1 + n // 512 frames."""
    librosa = load_librosa()
    count = 1 + len(samples) // HOP
    mel, percussive_mel = np.empty((2, MELS, count), dtype=np.float32)
    harmonic = np.empty(count * HOP, dtype=np.float32)
    for piece in _pieces(samples):
        spectrum = librosa.stft(piece.samples, n_fft=FFT, hop_length=HOP)
        magnitude = np.abs(spectrum)
        mel[:, piece.frames] = _mel(magnitude, rate)[:, piece.inside]
        # Notes are steady along time and percussion along frequency: medians each way tell them apart.
        steady, sudden = _row_medians(magnitude), _row_medians(magnitude.T).T
        shares = []
        for share, other in ((steady, sudden), (sudden, steady)):
            mask = librosa.util.softmask(share, other, power=2, split_zeros=True)
            shares.append(librosa.istft(spectrum * mask, hop_length=HOP, length=len(piece.samples)))
        own = shares[0][piece.inside.start * HOP : piece.inside.stop * HOP]
        harmonic[piece.frames.start * HOP :][: len(own)] = own
        percussive_mel[:, piece.frames] = _mel(_magnitude(shares[1]), rate)[:, piece.inside]
    return Spectra(mel, percussive_mel, harmonic[: len(samples)])


def tuning(samples: NDArray[np.float32], rate: int, bins: int) -> float:
    """`librosa.estimate_tuning`: how far the music is from A = 440 Hz, in bins (`bins` an octave)."""
    librosa = load_librosa()
    pitches, heights = [], []
    for piece in _pieces(samples):
        pitch, height = librosa.piptrack(S=_magnitude(piece.samples)[:, piece.inside], sr=rate)
        pitches.append(pitch[pitch > 0])
        heights.append(height[pitch > 0])
    pitch, height = np.concatenate(pitches), np.concatenate(heights)
    if not len(pitch):
        return 0.0
    return float(librosa.pitch_tuning(pitch[height >= np.median(height)], bins_per_octave=bins))


def _pieces(samples: NDArray[np.float32]) -> Iterator[_Piece]:
    count = 1 + len(samples) // HOP
    for start in range(0, count, _PIECE):
        stop = min(start + _PIECE, count)
        # The last piece takes the rest as it is: librosa reflects the end of the sound, no other edge.
        first, last = max(0, start - _MARGIN), stop + _MARGIN
        around = samples[first * HOP :] if last >= count else samples[first * HOP : (last - 1) * HOP]
        yield _Piece(around, slice(start, stop), slice(start - first, stop - first))


def _magnitude(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.abs(load_librosa().stft(samples, n_fft=FFT, hop_length=HOP)))


def _mel(magnitude: NDArray[np.float32], rate: int) -> NDArray[np.float32]:
    power = load_librosa().feature.melspectrogram(S=magnitude * magnitude, sr=rate, n_mels=MELS)
    return np.asarray(power, dtype=np.float32)


def _row_medians(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N, M] -> [N, M]: running medians of 31 along each row, the ends continued by reflection."""
    from scipy.ndimage import median_filter

    reach = _MEDIAN // 2
    padded = np.pad(values, ((0, 0), (reach, reach)), mode="symmetric")  # rows cannot reach each other
    return np.asarray(median_filter(padded.ravel(), _MEDIAN).reshape(padded.shape)[:, reach:-reach])
