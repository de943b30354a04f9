"""Audio features of a song, one row per motion frame: what `audio.npy` of a dance holds."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import AudioSettings, audio_features
from motionloom.datasets.synth.song import Song, render_song

_PUBLISHED = 60.0
"""Frames a second of features where a motion's own rate has no whole number of samples per frame."""


def settings_for(fps: float) -> AudioSettings:
    """Settings of the features of a motion of `fps` frames a second."""
    whole = fps >= 5 and fps * 512 == int(fps * 512)
    return AudioSettings(fps=fps if whole else _PUBLISHED)


@lru_cache(maxsize=64)
def song_rows(song: Song, rate: int, fps: float) -> NDArray[np.float32]:
    """Features [frames, 438] of a whole song; row t belongs to t / fps seconds. Read-only.

    Made from the whole song, like the features of real dances: its beats and loudness are the song's.
    """
    settings = settings_for(fps)
    rows = audio_features(render_song(song, rate), rate, settings)
    frames = int(song.seconds * fps)
    if settings.fps != fps:
        rows = rows[np.minimum(np.round(np.arange(frames) / fps * settings.fps).astype(int), len(rows) - 1)]
    rows = np.ascontiguousarray(rows[np.minimum(np.arange(frames), len(rows) - 1)])
    rows.setflags(write=False)
    return rows
