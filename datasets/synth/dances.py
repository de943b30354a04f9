"""Dances to songs: which clips dance to which song, and how.

Plan: everything is a pure function of (config, number). Clips of one song are all of one split, so that the
songs, and with `hold_out_tempi` whole ranges of tempi, are new to whoever learned from the training split.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from pydantic import Field, field_validator, model_validator

from motionloom.datasets.actions.dances import Record
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.records import Split
from motionloom.datasets.synth.actions.pose import Track
from motionloom.datasets.synth.actions.truth import Span, Truth
from motionloom.datasets.synth.choreography import choreograph
from motionloom.datasets.synth.music.genres import GENRES
from motionloom.datasets.synth.music.song import BEATS, Song, draw_song

Ranges = TypeVar("Ranges", tuple[int, int], list[tuple[int, int]])
Comes = Literal["text", "audio", "both", "none"]
_GOLDEN = 0.6180339887498949


class DanceConditions(Config):
    """Weights of dances with captions alone, music alone, both, or neither."""

    text: float = Field(0.0, ge=0)
    audio: float = Field(0.0, ge=0)
    both: float = Field(1.0, ge=0)
    none: float = Field(0.0, ge=0)

    @model_validator(mode="after")
    def _some(self) -> DanceConditions:
        if self.text + self.audio + self.both + self.none <= 0:
            raise ValueError("at least one of text, audio, both and none needs a weight above 0")
        return self

    def of(self, number: int) -> Comes:
        """Return the conditions of dance `number`: exact shares, by a low-discrepancy sequence."""
        weights = np.array([self.text, self.audio, self.both, self.none])
        ends = np.cumsum(weights / weights.sum())
        names: tuple[Comes, ...] = ("text", "audio", "both", "none")
        place = int(np.searchsorted(ends, (number * _GOLDEN + 0.5) % 1.0, side="right"))
        return names[min(place, int(np.flatnonzero(weights)[-1]))]


class DanceConfig(Config):
    """Dances to songs: several clips of each song of a pool, each with its own start in the song."""

    songs: int = Field(24, ge=1)
    """Songs in the pool."""
    song_seconds: float = Field(40.0, ge=2, le=600)
    """Length of a song."""
    in_a_row: int = Field(1, ge=1)
    """Dances, one after another, to the same song, each from its own start; more save playing it again."""
    tempo: tuple[int, int] = (80, 160)
    """Slowest and fastest song, beats a minute."""
    music: Literal["even", "played"] = "even"
    """Metronomes of the built-in synthesiser, or songs that a band plays and a studio records: with a form,
    breaks, drifting tempi and real instruments. Those need FluidSynth and a sound font (`pipeline/songs`)."""
    hold_out_tempi: list[tuple[int, int]] = Field(default_factory=list)
    """Ranges of beats a minute whose songs are kept for testing, for example `[[110, 119]]`."""
    share: float | None = Field(None, gt=0, le=1)
    """Share of dances among the clips; None = as much as any other action."""
    conditions: DanceConditions = DanceConditions()
    columns: Literal["public", "rhythm"] = "public"
    """Features of the music: the 438 published ones, or those of `audio/rhythm_features.py`."""

    @field_validator("tempo", "hold_out_tempi")
    @classmethod
    def _ranges(cls, value: Ranges) -> Ranges:
        for low, high in [value] if isinstance(value, tuple) else value:
            if not 60 <= low <= high <= 190:
                raise ValueError(f"tempi are [slowest, fastest] within 60 and 190, not {low}, {high}")
        return value

    @property
    def width(self) -> int:
        """Number of those columns."""
        from motionloom.datasets.audio.features import DIM
        from motionloom.datasets.audio.rhythm_features import RHYTHM_DIM

        return DIM if self.columns == "public" else RHYTHM_DIM

    def song(self, number: int, seed: int) -> Song:
        return draw_song(
            number, seed, tempo=self.tempo, seconds=self.song_seconds, played=self.music == "played"
        )

    def split(self, song: Song, test: float, val: float) -> Split:
        """Split of all clips of a song; these shares of songs are kept. Songs come in rounds of all genres,
        so the first are balanced."""
        if any(low <= song.bpm <= high for low, high in self.hold_out_tempi):
            return "test"
        tested = round(self.songs * test)
        if song.number < tested:
            return "test"
        return "val" if song.number < tested + round(self.songs * val) else "train"


@dataclass(frozen=True)
class DanceTruth(Truth):
    """Attributes of a dance to a song."""

    genre: str = ""
    song: int = 0
    """Number in the pool."""
    key: int = 0
    """Semitones of the song's key note above A."""
    song_start: float = 0.0
    """Seconds from the start of the song to that of the clip."""
    first_beat: float = 0.0
    """Seconds from the start of the clip to its first beat; the others follow each 60 / bpm seconds."""
    bar_beat: int = 0
    """Number of that beat in its bar, from 0."""
    beats: tuple[float, ...] = ()
    """Seconds from the start of the clip of all beats of a played song; `first_beat` begins them."""

    def record(self, *, hands: bool, face: bool) -> Record:
        data = super().record(hands=hands, face=face)
        if not self.beats:
            del data["beats"]
        return data


@dataclass(frozen=True)
class Dance:
    """One dance before it is animated."""

    truth: DanceTruth
    song: Song
    start: int
    """First frame, counted from the start of the song."""
    frames: int
    comes: Comes

    def seconds(self, fps: float) -> float:
        """Seconds from the start of the song to that of the dance."""
        return self.start / fps


def plan_dance(number: int, index: int, dances: DanceConfig, seed: int, span: Span, fps: float) -> Dance:
    """Dance `number`, which is clip `index`."""
    rng = np.random.default_rng([seed, index, 0])
    # All songs of the pool once, in shuffled order, before any comes again (for `in_a_row` dances each).
    turn, place = divmod(number // dances.in_a_row, dances.songs)
    order = np.random.default_rng([seed, turn, 233]).permutation(dances.songs)
    song = dances.song(int(order[place]), seed)
    whole = int(song.seconds * fps)
    frames = min(max(8, round(span.pick(rng, at_least=min(4.0, span.high)) * fps)), whole)
    start = int(rng.integers(whole - frames + 1))
    first = song.beat_number(start / fps)
    genre = song.style
    truth = DanceTruth(
        "dance",
        left_hand=genre.hand,
        right_hand=genre.hand,
        face=genre.face,
        bpm=song.bpm,
        style=genre.style,
        genre=song.genre,
        song=song.number,
        key=song.key,
        song_start=round(start / fps, 9),
        first_beat=round(float(song.times(first)) - start / fps, 9),
        bar_beat=first % song.meter,
        beats=tuple(song.beats_within(start / fps, frames / fps)) if song.played else (),
    )
    return Dance(truth, song, start, frames, dances.conditions.of(number))


def dance(truth: Truth, span: Span, fps: float, rng: np.random.Generator) -> Track:
    """A dance without music of the tempo and style that `truth` has, by one of the style's genres."""
    genres = [genre.name for genre in GENRES.values() if genre.style == truth.style]
    seconds = span.pick(rng, at_least=min(4.0, span.high))
    song = Song(0, 0, genres[int(rng.integers(len(genres)))], truth.bpm or 120, 0, seconds)
    start = rng.uniform(0.0, 8 * BEATS * song.beat)  # within both kinds of section
    return choreograph(song, start, round(seconds * fps), fps, rng)
