"""Recorded songs and their features: even ones by the built-in synthesiser, played ones by a `SongPlayer`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import DIM, features_of
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import Table, discover
from motionloom.datasets.synth.music.song import Song
from motionloom.datasets.synth.music.synthesizer import synthesize

PLAYED = "played"
"""Name of the player of songs that are not even."""


@dataclass(frozen=True)
class SongPlayer:
    """Plays songs in another way than the built-in synthesiser; `register` adds one."""

    name: str
    play: Callable[[Song, int], NDArray[np.float32]]
    """Song and sample rate -> mono samples [seconds * rate] in -1..1, the same bytes each time."""
    version: Callable[[], str]
    """What the sound depends on beside the song; `UserError` where nothing can play."""


PLAYERS: Table[SongPlayer] = Table(SongPlayer, "player of songs")


def player(name: str) -> SongPlayer:
    """A player by name; `UserError` where nobody has registered one."""
    discover()
    if name not in PLAYERS:
        raise UserError(
            f"music '{name}': nothing installed plays such songs; install motionloom with its folder "
            f"pipeline/songs, or take music: even"
        )
    return PLAYERS[name]


@lru_cache(maxsize=64)
def render_song(song: Song, rate: int) -> NDArray[np.float32]:
    """The whole song as mono samples [seconds * rate] in -1..1; read-only, the same bytes each time."""
    samples = player(PLAYED).play(song, rate) if song.played else synthesize(song, rate)
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
