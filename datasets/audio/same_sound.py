"""One piece of music in several files, whatever their codec, loudness, sample rate or beginning.

A sound's landmarks are pairs of peaks of its spectrogram: two frequencies and the time between them (Wang,
"An industrial-strength audio search algorithm", 2003). Files of one piece share many of them, all later by
the same time. Another performance, or one that is played faster, shares none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from motionloom.datasets.audio.sound import Sound

RATE, FFT, HOP = 8000, 1024, 128
_NEAR = (25, 31)
"""A peak is the loudest of so many bins (200 Hz) and frames (half a second)."""
_PAIRS, _LATEST = 5, 128
"""Each peak is paired with so many that follow, at most so many frames (2 s) later."""
_COMMON = 50
"""Landmarks that more places have say nothing: a drum, a tone that is held."""
LONGEST = 600.0
"""Seconds from its beginning that are known of a sound, in some 200 MB."""
_AT_ONCE = 2048
"""Frames that are transformed at once."""
SHARED = 0.05
"""Share of the shorter file's landmarks that two files of one piece have in common at least [ours]."""
_LEAST = 20


class Landmarks(NamedTuple):
    """The landmarks of a sound."""

    keys: NDArray[np.int64]
    """[N], both frequencies and the time between them in one number."""
    frames: NDArray[np.int64]
    """[N], where the first peak is."""


NO_LANDMARKS = Landmarks(np.empty(0, np.int64), np.empty(0, np.int64))


def landmarks(sound: Sound) -> Landmarks:
    """The landmarks of a sound; none of silence."""
    beginning = sound if sound.seconds <= LONGEST else sound.slice(0, LONGEST)
    samples = beginning.resampled(RATE).samples
    if len(samples) < FFT:
        return NO_LANDMARKS
    windows = np.lib.stride_tricks.sliding_window_view(samples, FFT)[::HOP]
    bell = np.hanning(FFT).astype(np.float32)
    starts = range(0, len(windows), _AT_ONCE)
    power = np.concatenate([np.abs(np.fft.rfft(windows[at : at + _AT_ONCE] * bell)) for at in starts]).T
    # Peaks, and none of what is 60 dB below the loudest: that is a codec's own.
    peaks = (power == maximum_filter(power, size=_NEAR)) & (power > 1e-3 * power.max())
    frames, bins = np.nonzero(peaks.T)
    keys = []
    firsts = []
    for later in range(1, _PAIRS + 1):
        apart = frames[later:] - frames[:-later]
        near = (apart > 0) & (apart <= _LATEST)
        keys.append((bins[:-later][near] * FFT + bins[later:][near]) * (_LATEST + 1) + apart[near])
        firsts.append(frames[:-later][near])
    return Landmarks(np.concatenate(keys), np.concatenate(firsts))


def same_pieces(sounds: Mapping[str, Landmarks]) -> list[tuple[str, str]]:
    """Pairs of names whose sounds are one piece, in the order of their names."""
    names = list(sounds)
    keys = np.concatenate([one.keys for one in sounds.values()] or [np.empty(0, np.int64)])
    frames = np.concatenate([one.frames for one in sounds.values()] or [np.empty(0, np.int64)])
    owners = np.repeat(np.arange(len(names)), [len(one.keys) for one in sounds.values()])
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    frames = frames[order]
    owners = owners[order]
    # Places with the same landmark stand together: each is compared with the next, the one after that, ...
    _, sizes = np.unique(keys, return_counts=True)
    rare = np.repeat(sizes <= _COMMON, sizes)
    keys = keys[rare]
    frames = frames[rare]
    owners = owners[rare]
    votes = []
    for step in range(1, _COMMON):
        same = (keys[step:] == keys[:-step]) & (owners[step:] != owners[:-step])
        if len(same):
            delay = frames[step:][same] - frames[:-step][same]
            votes.append(np.stack([owners[:-step][same], owners[step:][same], delay], axis=1))
    found: dict[tuple[int, int], int] = {}
    if votes:
        rows, counts = np.unique(np.concatenate(votes), axis=0, return_counts=True)
        for (first, second, _), count in zip(rows.tolist(), counts.tolist(), strict=True):
            found[first, second] = max(found.get((first, second), 0), count)
    return [
        (names[first], names[second])
        for (first, second), count in sorted(found.items())
        if count >= max(_LEAST, SHARED * min(len(sounds[names[k]].keys) for k in (first, second)))
    ]
