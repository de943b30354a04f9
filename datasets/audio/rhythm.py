"""Tempogram and beats of onset strengths by librosa, long music block by block.

librosa's tempogram takes some 20 kB a frame while it is made, and its beat tracker makes another one only to
know the mean of it. Both are the same when they are made in blocks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.compiled import load_librosa
from motionloom.datasets.audio.spectra import HOP

_BLOCK = 2048
_TEMPO_SECONDS = 8.0
"""Length of the windows that the tempo is measured in, as in `librosa.feature.tempo`."""


def onset_strength(mel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mel power [128, T] -> [T]: the median rise over the bands."""
    librosa = load_librosa()
    strength = librosa.onset.onset_strength(S=librosa.power_to_db(mel), aggregate=np.median)
    return np.asarray(strength)


def tempogram(onsets: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Onset strengths [T] -> [width, T]: autocorrelation around each frame, the largest value 1."""
    return np.concatenate([block.astype(np.float32) for block in _tempograms(onsets, width)], axis=1)


def track_beats(
    onsets: NDArray[np.float32], rate: int, *, start_bpm: float, tightness: float
) -> NDArray[np.int64]:
    """`librosa.beat.beat_track`: frames of the beats of onset strengths [T], ascending."""
    librosa = load_librosa()
    if not onsets.any():
        return np.empty(0, dtype=np.int64)
    width = int(librosa.time_to_frames(_TEMPO_SECONDS, sr=rate, hop_length=HOP))
    mean = sum(block.sum(axis=1, keepdims=True) for block in _tempograms(onsets, width)) / len(onsets)
    tempo = librosa.feature.tempo(tg=mean, sr=rate, hop_length=HOP, start_bpm=start_bpm)
    with np.errstate(divide="ignore"):  # at 5 frames a second a beat can be a frame, and 0 a step it refuses
        _, found = librosa.beat.beat_track(
            onset_envelope=onsets, sr=rate, hop_length=HOP, bpm=tempo, tightness=tightness
        )
    return np.asarray(found)


def flags(frames: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """[count] of zeros, 1 at the frames."""
    out = np.zeros(count, dtype=np.float32)
    out[frames] = 1
    return out


def _tempograms(onsets: NDArray[np.float32], width: int) -> Iterator[NDArray[np.float64]]:
    """[width, frames] of block after block."""
    padded = np.pad(onsets, width // 2, mode="linear_ramp", end_values=0)
    for start in range(0, len(onsets), _BLOCK):
        stop = min(start + _BLOCK, len(onsets))
        around = padded[start : stop + width - 1]
        yield load_librosa().feature.tempogram(onset_envelope=around, win_length=width, center=False)
