"""What dances to songs are made of by a config: pool of songs, who dances to which, splits, what comes along.

Everything is a pure function of (config, number). Clips of one song are all of one split, so that the songs,
and with `hold_out_tempi` whole ranges of tempi, are new to whoever learned from the training split.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from motionloom.datasets.schema import Config, Split
from motionloom.datasets.synth.choreography import beat_number
from motionloom.datasets.synth.genres import GENRES
from motionloom.datasets.synth.song import BEATS, Song, draw_song
from motionloom.datasets.synth.truth import Span, Truth

Comes = Literal["text", "audio", "both", "none"]
_GOLDEN = 0.6180339887498949


class DanceConditions(Config):
    """What dances come with, as weights: captions alone, music alone, both, or the motion alone."""

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
        """What dance `number` comes with: exact shares, spread evenly (a low-discrepancy sequence)."""
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
    genres: list[str] | None = None
    """None = all; otherwise names of `genres.GENRES`. A genre decides the style of its dances."""
    tempo: tuple[int, int] = (80, 160)
    """Slowest and fastest song, beats a minute."""
    hold_out_songs: float | None = Field(None, ge=0, lt=1)
    """Share of the songs that only test clips dance to; None = the config's `test_fraction`. Validation has
    songs of its own too, `val_fraction` of them."""
    hold_out_tempi: list[tuple[int, int]] = Field(default_factory=list)
    """Ranges of beats a minute whose songs are kept for testing, for example `[[110, 119]]`."""
    share: float | None = Field(None, gt=0, le=1)
    """Share of dances among the clips; None = as much as any other action."""
    conditions: DanceConditions = DanceConditions()
    sound: bool = True
    """Store the sound beside its features."""
    sample_rate: int = Field(16_000, ge=8_000, le=48_000)
    """Of the sound, Hz."""

    @field_validator("genres")
    @classmethod
    def _known(cls, names: list[str] | None) -> list[str] | None:
        wrong = sorted(set(names or []) - set(GENRES))
        if wrong or names == []:
            raise ValueError(f"no genre {', '.join(wrong) or 'given'}; known: {', '.join(GENRES)}")
        return names

    @field_validator("tempo", "hold_out_tempi")
    @classmethod
    def _ranges(cls, value: Any) -> Any:
        for low, high in [value] if isinstance(value, tuple) else value:
            if not 60 <= low <= high <= 170:
                raise ValueError(f"tempi are [slowest, fastest] within 60 and 170, not {low}, {high}")
        return value

    def song(self, number: int, seed: int) -> Song:
        """Song `number` of the pool."""
        names = tuple(self.genres or GENRES)
        return draw_song(number, seed, genres=names, tempo=self.tempo, seconds=self.song_seconds)

    def split(self, song: Song, test: float, val: float) -> Split:
        """Split of all clips of a song. Songs come in rounds of all genres, so the first are balanced."""
        if any(low <= song.bpm <= high for low, high in self.hold_out_tempi):
            return "test"
        tested = round(self.songs * (test if self.hold_out_songs is None else self.hold_out_songs))
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
    """Where in the song the clip begins, seconds."""
    first_beat: float = 0.0
    """Seconds from the start of the clip to its first beat; the others follow each 60 / bpm seconds."""
    bar_beat: int = 0
    """Which beat of the bar that is, from 0."""


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
        """Where in the song the dance begins."""
        return self.start / fps


def song_of(number: int, dances: DanceConfig, seed: int) -> Song:
    """The song of dance `number`: all songs of the pool once, in shuffled order, before any comes again."""
    turn, place = divmod(number, dances.songs)
    order = np.random.default_rng([seed, turn, 233]).permutation(dances.songs)
    return dances.song(int(order[place]), seed)


def plan_dance(number: int, index: int, dances: DanceConfig, seed: int, span: Span, fps: float) -> Dance:
    """Dance `number`, which is clip `index`."""
    rng = np.random.default_rng([seed, index, 0])
    song = song_of(number, dances, seed)
    whole = int(song.seconds * fps)
    frames = min(max(8, round(span.pick(rng, at_least=min(4.0, span.high)) * fps)), whole)
    start = int(rng.integers(whole - frames + 1))
    first = beat_number(song, start / fps)
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
        first_beat=round(first * song.beat - start / fps, 9),
        bar_beat=first % BEATS,
    )
    return Dance(truth, song, start, frames, dances.conditions.of(number))


def beats_of(truth: dict[str, Any], seconds: float) -> list[float]:
    """Times of the beats inside a clip of `seconds` by its truth record (`ClipMeta.truth`)."""
    beat = 60.0 / truth["bpm"]
    count = max(0, int(np.ceil((seconds - truth["first_beat"]) / beat - 1e-9)))
    return [truth["first_beat"] + k * beat for k in range(count)]
