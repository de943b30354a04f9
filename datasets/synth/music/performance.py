"""The sound of a song, and its features: by the built-in synthesiser, or by a band and what records it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import DIM, features_of
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.synth.music.band import play_band
from motionloom.datasets.synth.music.recording import record
from motionloom.datasets.synth.music.song import Song
from motionloom.datasets.synth.music.synthesizer import synthesize


@lru_cache(maxsize=64)
def render_song(song: Song, rate: int) -> NDArray[np.float32]:
    """The whole song as mono samples [seconds * rate] in -1..1; read-only, the same bytes each time."""
    if song.played:
        samples = record(play_band(song, rate), rate, np.random.default_rng([song.seed, song.number, 257]))
    else:
        samples = synthesize(song, rate)
    samples.setflags(write=False)
    return samples


@lru_cache(maxsize=64)
def song_features(song: Song, rate: int, fps: float, width: int = DIM) -> NDArray[np.float32]:
    """Audio features [frames, width] of a whole song; row t is at t / fps seconds. Read-only.

    Computed from the whole song, like the features of real dances: its beats and loudness are the song's.
    """
    rows = features_of(Sound(render_song(song, rate), rate), fps, width)[: int(song.seconds * fps)]
    rows = np.ascontiguousarray(rows)
    rows.setflags(write=False)
    return rows
