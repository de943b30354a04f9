"""Stage `songs`: rendered songs with known beats, which the beat network learns from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.audio.beat_net import band_power, levels
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.music.recording import render_song
from motionloom.datasets.synth.music.song import Song, draw_song
from motionloom.pipeline.contract.stage import (
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)

RENDER_RATE = 32_000
"""Hz; one that every codec of recordings knows."""


class SongsConfig(StageConfig):
    """A recipe's `kind: songs`; played ones need a band (`pip install 'motionloom[band]'`)."""

    songs: int = Field(600, ge=2)
    song_seconds: float = Field(30.0, ge=10)
    tempo: tuple[int, int] = (60, 190)
    """Beats a minute, of the slowest and the fastest."""
    seed: int = Field(0, ge=0)
    validation: float = Field(0.1, gt=0, lt=1)
    """Share of the songs that is not trained on: the last ones."""
    played: bool = True
    """By a band; otherwise by the built-in synthesiser, as metronomes."""

    def song(self, number: int) -> Song:
        """Return one of the band's songs."""
        return draw_song(number, self.seed, tempo=self.tempo, seconds=self.song_seconds, played=self.played)

    def split(self, validation: bool) -> range:
        """Return the numbers of the songs that are kept back, or of the others."""
        first = self.songs - max(1, round(self.songs * self.validation))
        return range(first, self.songs) if validation else range(first)


@dataclass(frozen=True)
class AnnotatedSong:
    """A song's levels and beats."""

    levels: NDArray[np.float16]
    """Levels [T, 64], 60 rows a second."""
    beats: NDArray[np.float64]
    """[K] seconds."""
    downbeats: NDArray[np.bool_]
    """[K]"""

    @classmethod
    def of(cls, song: Song) -> AnnotatedSong:
        """Render a song; seconds of work."""
        first = song.beat_number(0.0)
        beats = np.array(song.beats_within(0.0, song.seconds))
        downbeats = (first + np.arange(len(beats))) % song.meter == 0
        sound = Sound(render_song.__wrapped__(song, RENDER_RATE), RENDER_RATE)
        return cls(levels(band_power(sound)).astype(np.float16), beats, downbeats)

    def save(self, path: Path) -> None:
        """Write it as .npz."""
        with atomic_file(path) as file:
            np.savez(file, levels=self.levels, beats=self.beats, downbeats=self.downbeats)

    @classmethod
    def load(cls, path: Path) -> AnnotatedSong:
        """Read what `save` wrote; `UserError` for a file that is missing or damaged."""
        try:
            with np.load(path, allow_pickle=False) as file:
                return cls(file["levels"], file["beats"], file["downbeats"])
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path}: no song ({error}); run the stage that made it again") from None


@dataclass(frozen=True)
class SongPool:
    """The songs of a finished stage."""

    folder: Path
    config: SongsConfig

    def songs(self, *, validation: bool) -> list[AnnotatedSong]:
        """Return the songs of one of the two splits, in memory: some 250 kB each."""
        return [AnnotatedSong.load(_path(self.folder, number)) for number in self.config.split(validation)]


class SongsStage(StageKind[SongsConfig]):
    """Renders the songs, several at once; those that a killed run has rendered are kept."""

    name = "songs"
    summary = "played songs with known beats"
    config = SongsConfig

    def run(self, context: StageContext) -> None:
        config: SongsConfig = context.config
        missing = [number for number in range(config.songs) if not _path(context.folder, number).is_file()]
        with Workers(context.hardware.convert_workers) as workers:
            for _ in workers.run(partial(_render, config, context.folder), missing):
                pass
        context.console.print(f"    {config.songs} songs of {config.song_seconds:g} s")

    def preview(self, config: SongsConfig, given: Inputs) -> SongPool:
        return SongPool(Path(), config)

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> SongPool:
        return SongPool(stage.folder, stage.config)


def _path(folder: Path, number: int) -> Path:
    return folder / f"song-{number:05}.npz"


def _render(config: SongsConfig, folder: Path, number: int) -> None:
    AnnotatedSong.of(config.song(number)).save(_path(folder, number))


register(SongsStage())
