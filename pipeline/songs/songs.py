"""Stage `songs`: songs with known beats, which the beat network learns from.

Every second one is an excerpt of a MIDI file where `scores` names some, the others are composed here; all are
arranged so that the beat hides (`arrangement`). Drums, bass and the others are recorded apart, so that a
training mixes a song anew each time, with some of them silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.audio.beat_net import band_power
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.synth.music.song import draw_song
from motionloom.pipeline.contract.stage import (
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.songs.arrangement import Arrangement, hidden
from motionloom.pipeline.songs.band import band_version, instruments, score
from motionloom.pipeline.songs.scores import excerpt, scores
from motionloom.pipeline.songs.studio import record

RENDER_RATE = 32_000
"""Hz."""
_SILENCE = 1e-9
"""Power against full scale that is added before the logarithm."""


class SongsConfig(StageConfig):
    """A recipe's `kind: songs`; needs a band (`pip install 'motionloom[band]'`)."""

    songs: int = Field(1600, ge=2)
    song_seconds: float = Field(32.0, ge=10)
    tempo: tuple[int, int] = (60, 190)
    """Beats a minute, of the slowest and the fastest."""
    seed: int = Field(0, ge=0)
    validation: float = Field(0.05, gt=0, lt=1)
    """Share of the songs, and of the MIDI files, that is not trained on: the last ones."""
    scores: tuple[Path, ...] = ()
    """MIDI files (*.mid, *.wad), or folders of them; every second song is an excerpt of one."""

    def split(self, validation: bool) -> range:
        """Return the numbers of the songs that are kept back, or of the others."""
        first = self.songs - max(1, round(self.songs * self.validation))
        return range(first, self.songs) if validation else range(first)

    def arranged(self, number: int) -> Arrangement:
        """Return what is played in a song."""
        rng = np.random.default_rng([self.seed, number, 263])
        if self.scores and number % 2:
            pieces = scores(self.scores)
            kept = max(1, round(len(pieces) * self.validation))
            own = pieces[-kept:] if number in self.split(True) else pieces[:-kept] or pieces
            return hidden(excerpt(own[number // 2 % len(own)], self.song_seconds, rng), rng)
        song = draw_song(number, self.seed, tempo=self.tempo, seconds=self.song_seconds, played=True)
        numbers = np.arange(-song.meter, int(2 * song.seconds / song.beat) + song.meter)
        downbeats = numbers % song.meter == 0
        piece = Arrangement(score(song), instruments(song, rng), song.times(numbers), downbeats)
        return hidden(piece, rng)


@dataclass(frozen=True)
class AnnotatedSong:
    """A song's stems and beats."""

    stems: NDArray[np.float16]
    """[S, T, 64] decimal logarithms of the power of bands, 60 rows a second, of `arrangement.STEMS`."""
    beats: NDArray[np.float64]
    """[K] seconds."""
    downbeats: NDArray[np.bool_]
    """[K]"""

    @classmethod
    def of(cls, piece: Arrangement, seconds: float, seed: list[int]) -> AnnotatedSong:
        """Play and record a piece, all its stems in one studio; a second of work."""
        power = []
        for dry in piece.stems(seconds, RENDER_RATE):
            loudest = float(np.abs(dry).max())
            sound = record(dry, RENDER_RATE, np.random.default_rng(seed), coded=False) if loudest else dry
            power.append(np.log10(band_power(Sound(sound, RENDER_RATE)) + _SILENCE))
        inside = (piece.beats >= 0) & (piece.beats < seconds)
        return cls(np.stack(power).astype(np.float16), piece.beats[inside], piece.downbeats[inside])

    def save(self, path: Path) -> None:
        """Write it as .npz."""
        with atomic_file(path) as file:
            np.savez(file, stems=self.stems, beats=self.beats, downbeats=self.downbeats)

    @classmethod
    def load(cls, path: Path) -> AnnotatedSong:
        """Read what `save` wrote; `UserError` for a file that is missing or damaged."""
        with NpzFile(path) as file:
            stems = file.array("stems")
            beats = file.numbers("beats")
            downbeats = file.array("downbeats")
        if stems.ndim != 3 or stems.dtype != np.float16 or beats.shape != downbeats.shape or beats.ndim != 1:
            raise UserError(f"{path}: not a song; run the stage that made it again")
        return cls(stems, beats, downbeats.astype(bool))


@dataclass(frozen=True)
class SongPool:
    """The songs of a finished stage."""

    folder: Path
    config: SongsConfig

    def songs(self, *, validation: bool) -> list[AnnotatedSong]:
        """Return the songs of one of the two splits, in memory: some 700 kB each."""
        return [AnnotatedSong.load(_path(self.folder, number)) for number in self.config.split(validation)]


class SongsStage(StageKind[SongsConfig]):
    """Plays the songs, several at once; those that a killed run has played are kept."""

    name = "songs"
    summary = "played songs with known beats"
    config = SongsConfig

    def run(self, context: StageContext) -> None:
        config: SongsConfig = context.config
        band_version()
        missing = [number for number in range(config.songs) if not _path(context.folder, number).is_file()]
        with Workers(context.hardware.convert_workers) as workers:
            for _ in workers.run(partial(_play, config, context.folder), missing):
                pass
        context.console.print(f"    {config.songs} songs of {config.song_seconds:g} s")

    def preview(self, config: SongsConfig, given: Inputs) -> SongPool:
        return SongPool(Path(), config)

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> SongPool:
        return SongPool(stage.folder, stage.config)


def _path(folder: Path, number: int) -> Path:
    return folder / f"song-{number:05}.npz"


def _play(config: SongsConfig, folder: Path, number: int) -> None:
    song = AnnotatedSong.of(config.arranged(number), config.song_seconds, [config.seed, number, 269])
    song.save(_path(folder, number))


register(SongsStage())
