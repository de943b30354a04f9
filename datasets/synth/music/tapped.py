"""Played songs as a listener of beats learns from them: what is heard, row by row, and where the beats are.

A batch is a pure function of (seed, number): stretches of songs, and what else the world does to them. They
are played faster or slower, through other equalisers, under noise and fading, with parts of the spectrum or
of the time missing; some are no music at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.audio.beat_net import BANDS, ROWS, band_power, levels
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.synth.music.genres import GENRES
from motionloom.datasets.synth.music.performance import render_song
from motionloom.datasets.synth.music.recording import record
from motionloom.datasets.synth.music.scores import excerpt, scores
from motionloom.datasets.synth.music.song import Song, draw_song

RENDER_RATE = 32_000
"""Hz; one that every codec of recordings knows."""
_WIDE = 1.5
"""Rows from a beat at which its target is 0; a row away it is one half."""


class SongPoolConfig(Config):
    """Which songs are rendered."""

    songs: int = Field(600, ge=2)
    song_seconds: float = Field(30.0, ge=10)
    tempo: tuple[int, int] = (60, 190)
    """Beats a minute, of the slowest and the fastest."""
    seed: int = Field(0, ge=0)
    validation: float = Field(0.1, gt=0, lt=1)
    """Share of the songs that is not trained on: the last ones."""
    played: bool = True
    """By a band; otherwise by the built-in synthesiser, as metronomes."""

    scores: Path | None = None
    """A folder of MIDI files (*.mid); every second song is an excerpt of one of them."""

    def tapped(self, number: int) -> TappedSong:
        """One of the songs, rendered; seconds of work."""
        if self.scores is None or number % 2 == 0:
            return TappedSong.of(self.song(number))
        pieces = scores(self.scores)
        kept = max(1, round(len(pieces) * self.validation))  # whole pieces are kept back
        own = pieces[-kept:] if number in self.split(True) else pieces[:-kept] or pieces
        rng = np.random.default_rng([self.seed, number, 263])
        dry, beats, downbeats = excerpt(own[number // 2 % len(own)], self.song_seconds, RENDER_RATE, rng)
        return TappedSong.heard_in(record(dry, RENDER_RATE, rng), beats, downbeats)

    def song(self, number: int) -> Song:
        """One of the band's songs."""
        return draw_song(
            number,
            self.seed,
            genres=tuple(GENRES),
            tempo=self.tempo,
            seconds=self.song_seconds,
            played=self.played,
        )

    def split(self, validation: bool) -> range:
        """Numbers of the songs that are kept back, or of the others."""
        first = self.songs - max(1, round(self.songs * self.validation))
        return range(first, self.songs) if validation else range(first)


@dataclass(frozen=True)
class TappedSong:
    """A song as it is heard and counted."""

    heard: NDArray[np.float16]
    """Levels [T, 64], 60 rows a second."""
    beats: NDArray[np.float64]
    """[K] seconds."""
    downbeats: NDArray[np.bool_]
    """[K]"""

    @classmethod
    def of(cls, song: Song) -> TappedSong:
        """Render a song; seconds of work."""
        first = song.beat_number(0.0)
        beats = np.array(song.beats_within(0.0, song.seconds))
        downbeats = (first + np.arange(len(beats))) % song.meter == 0
        return cls.heard_in(render_song.__wrapped__(song, RENDER_RATE), beats, downbeats)

    @classmethod
    def heard_in(
        cls, samples: NDArray[np.float32], beats: NDArray[np.float64], downbeats: NDArray[np.bool_]
    ) -> TappedSong:
        """Samples [n] at the rate of rendering, with the seconds of their beats."""
        sound = Sound(samples, RENDER_RATE)
        return cls(levels(band_power(sound)).astype(np.float16), beats, downbeats)

    def save(self, path: Path) -> None:
        """As .npz."""
        with atomic_file(path) as file:
            np.savez(file, heard=self.heard, beats=self.beats, downbeats=self.downbeats)

    @classmethod
    def load(cls, path: Path) -> TappedSong:
        """`UserError` for a file that is missing or damaged."""
        try:
            with np.load(path, allow_pickle=False) as file:
                return cls(file["heard"], file["beats"], file["downbeats"])
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path}: no song ({error}); run the stage that made it again") from None


class TappedBatch(TypedDict):
    """Stretches of songs."""

    levels: Tensor
    """[B, T, 64]"""
    targets: Tensor
    """[B, T, 2] of beats and downbeats, 0..1."""
    length: Tensor
    """[B], all T; a module counts the rows of a validation batch by it."""


class TappedBatches(Dataset[TappedBatch]):
    """Item k is one rank's rows of global batch k."""

    def __init__(
        self,
        songs: Sequence[TappedSong],
        rows: int,
        batch: int,
        seed: int,
        rank: int = 0,
        world: int = 1,
        *,
        augment: bool = True,
    ) -> None:
        shortest = min(len(song.heard) for song in songs)
        if shortest < rows:
            raise UserError(f"window_seconds: {rows / ROWS:g} is longer than songs of {shortest / ROWS:g} s")
        self.songs, self.rows, self.augment = songs, rows, augment
        self.seed, self.at = seed, (rank, world)
        self.plan = BatchPlan(len(songs), batch, seed)

    def __len__(self) -> int:
        return self.plan.batches_per_epoch  # of validation; training asks for as many as it has steps

    def __getitem__(self, k: int) -> TappedBatch:
        turns, items = self.plan.local(k, *self.at)
        cut = [
            self._stretch(self.songs[item], np.random.default_rng([self.seed, turn, item, 271]))
            for turn, item in zip(turns.tolist(), items.tolist(), strict=True)
        ]
        heard, targets = (torch.from_numpy(np.stack(part)) for part in zip(*cut, strict=True))
        return {"levels": heard, "targets": targets, "length": torch.full((len(cut),), self.rows)}

    def _stretch(
        self, song: TappedSong, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Levels [rows, 64] and targets [rows, 2]."""
        speed = min(np.exp(rng.uniform(-0.16, 0.16)), len(song.heard) / self.rows) if self.augment else 1.0
        places = rng.uniform(0, len(song.heard) - speed * (self.rows - 1) - 1) + speed * np.arange(self.rows)
        before = places.astype(np.int64)
        share = (places - before)[:, None].astype(np.float32)
        around = song.heard[before[0] : before[-1] + 2].astype(np.float32)
        before -= before[0]
        heard = (1 - share) * around[before] + share * around[np.minimum(before + 1, len(around) - 1)]
        beats = (song.beats * ROWS - places[0]) / speed
        targets = np.stack([_targets(beats, self.rows), _targets(beats[song.downbeats], self.rows)], axis=1)
        if not self.augment:
            return heard, targets
        if rng.random() < 0.04:
            return _no_music(self.rows, rng), np.zeros_like(targets)
        return _changed(heard, rng), targets


def _targets(beats: NDArray[np.float64], rows: int) -> NDArray[np.float32]:
    """[rows] of beats at rows, parts of rows included: 1 within half a row, falling to 0."""
    if not len(beats):
        return np.zeros(rows, dtype=np.float32)
    at = np.arange(rows)
    after = np.searchsorted(beats, at)
    near = [np.abs(at - beats[np.clip(place, 0, len(beats) - 1)]) for place in (after - 1, after)]
    return np.clip(_WIDE - np.minimum(*near), 0, 1).astype(np.float32)


def _changed(heard: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Levels [T, 64] in another recording: equaliser, fading, noise, missing bands and a missing moment."""
    rows = len(heard)
    across, along = np.arange(BANDS) / BANDS, np.arange(rows) / rows
    out = heard + 0.3 * _curve(across, rng) + 0.2 * _curve(along, rng)[:, None]
    if rng.random() < 0.4:  # noise of some colour, at a level between well below the music and almost in it
        floor = rng.uniform(-3.0, -0.3) + 0.5 * _curve(across, rng)
        grain = 0.2 * rng.standard_normal(out.shape)
        out = np.log10(10.0**out + 10.0 ** (floor + grain))
        out -= out.mean(axis=0)
    if rng.random() < 0.3:
        out = np.roll(out, int(rng.integers(-3, 4)), axis=1)
    if rng.random() < 0.3:
        width = int(rng.integers(2, BANDS // 2))
        start = int(rng.choice([0, int(rng.integers(BANDS - width)), BANDS - width]))
        out[:, start : start + width] = 0
    if rng.random() < 0.3:
        length = int(rng.integers(6, 90))
        start = int(rng.integers(rows - length)) if rows > length else 0
        out[start : start + length] = out.min() if rng.random() < 0.3 else 0
    return (out * rng.uniform(0.7, 1.3)).astype(np.float32)


def _no_music(rows: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Levels [T, 64] of what has no beat: noise, in which nothing or all kinds of events come and go."""
    from scipy.ndimage import gaussian_filter

    out = np.zeros((rows, BANDS))
    for _ in range(int(rng.integers(1, 4))):
        smooth = (float(np.exp(rng.uniform(-1.0, 3.0))), float(np.exp(rng.uniform(-1.0, 3.0))))
        part = gaussian_filter(rng.standard_normal(out.shape), smooth)
        out += rng.uniform(0.05, 0.8) * part / max(float(part.std()), 1e-6)
    return np.asarray(out - out.mean(axis=0), dtype=np.float32)


def _curve(at: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """A smooth random curve over 0..1, deviation about 1."""
    waves = np.arange(1, 4)[:, None]
    phases = rng.uniform(0, 2 * np.pi, (3, 1))
    return np.asarray((rng.standard_normal((3, 1)) / waves * np.cos(np.pi * waves * at + phases)).sum(axis=0))
