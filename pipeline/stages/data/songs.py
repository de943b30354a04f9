"""Played songs with known beats, for a network that hears beats (`stages/networks/beats.py`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from motionloom.datasets.base.pool import Workers
from motionloom.datasets.synth.music.tapped import SongPoolConfig, TappedSong
from motionloom.pipeline.contract.stage import (
    Finished,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)


class SongsConfig(SongPoolConfig, StageConfig):
    """A recipe's `kind: songs`; played ones need a band (`pip install 'motionloom[band]'`)."""


@dataclass(frozen=True)
class SongPool:
    """The songs of a finished stage."""

    folder: Path
    config: SongsConfig

    def songs(self, *, validation: bool) -> list[TappedSong]:
        """Those of one of the two splits, in memory: some 250 kB each."""
        return [TappedSong.load(_path(self.folder, number)) for number in self.config.split(validation)]


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

    def load(self, stage: Finished, given: Inputs, device: torch.device) -> SongPool:
        return SongPool(stage.folder, stage.config)


def _path(folder: Path, number: int) -> Path:
    return folder / f"song-{number:05}.npz"


def _render(config: SongsConfig, folder: Path, number: int) -> None:
    config.tapped(number).save(_path(folder, number))


register(SongsStage())
