"""Songs: pieces of music with a genre, a tempo, a key and a form, to which several dances are danced.

A song is a pure function of (seed, number, options). It has a grid of beats, numbered from 0, and bars that
begin at every `meter`-th of them. *Even* songs, which the built-in synthesiser plays, are metronomes: their
first beat is at 0, their bars have four beats, and sections of four bars alternate between two kinds, A and
B. *Played* songs, for a band of real instruments (`pipeline/songs`), begin after a silence, drift in tempo,
may have three beats a bar, and have a form: intros, quiet and loud sections and breaks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from motionloom.datasets.synth.actions.maths import Array
from motionloom.datasets.synth.music.genres import GENRES, Genre

BEATS = 4
"""Beats of a bar of an even song."""
SECTION_BARS = 4
"""Bars of a section of an even song."""
_BEFORE = 16
"""Beats that the grid has before the song's first; dances begin with the bar before them."""
_GOLDEN = 0.6180339887498949
_EVEN_ENERGY = 0.75


@dataclass(frozen=True)
class Section:
    """A stretch of a played song."""

    bars: int
    kind: int
    """0 is A, 1 is B: which chords, and which moves of the dancer."""
    energy: float
    """0..1: how loud and full the band plays; 0 is a break, in which it holds a chord or rests."""


@dataclass(frozen=True)
class Song:
    """One piece of music."""

    number: int
    seed: int
    genre: str
    bpm: int
    """Beats a minute; of a played song on average."""
    key: int
    """Semitones of the key note above A."""
    seconds: float
    played: bool = False
    """A band's song rather than an even one."""
    first: float | None = None
    """Seconds to the first beat of a played song that goes with recorded motion: four beats a bar, one tempo,
    no intro and no breaks. None: all of these are drawn."""

    @property
    def beat(self) -> float:
        """Seconds of a beat, on average."""
        return 60.0 / self.bpm

    @property
    def style(self) -> Genre:
        """Its line of the table of genres."""
        return GENRES[self.genre]

    @cached_property
    def meter(self) -> int:
        """Beats of a bar."""
        return 3 if self.played and self.first is None and self._drawn(1).random() < 0.12 else BEATS

    @cached_property
    def form(self) -> tuple[Section, ...]:
        """Sections from beat 0 on, as many as fill the song; an even song's are all alike."""
        if not self.played:
            return (Section(SECTION_BARS, 0, _EVEN_ENERGY), Section(SECTION_BARS, 1, _EVEN_ENERGY))
        rng = self._drawn(2)
        bars = int(np.ceil(self.seconds / (self.beat * self.meter))) + 2
        out = (
            [Section(int(rng.integers(0, 5)), 0, float(rng.uniform(0.2, 0.5)))] if self.first is None else []
        )
        kind = int(rng.integers(2))
        while sum(section.bars for section in out) < bars:
            energy = rng.uniform(0.4, 0.7) if kind == 0 else rng.uniform(0.7, 1.0)
            out.append(Section(int(rng.choice([2, 4, 4, 8])), kind, float(energy)))
            if self.first is None and rng.random() < 0.3:
                out.append(Section(int(rng.integers(1, 3)), kind, 0.0))
            kind = 1 - kind if rng.random() < 0.75 else kind
        return tuple(section for section in out if section.bars)

    @cached_property
    def _grid(self) -> tuple[Array, Array]:
        """Seconds and numbers of the beats, from `_BEFORE` before the first to as many after the end."""
        numbers = np.arange(-_BEFORE, int(self.seconds / self.beat) + 3 * _BEFORE)
        if not self.played:
            return np.asarray(numbers * self.beat), numbers.astype(np.float64)
        if self.first is not None:
            return np.asarray(self.first + numbers * self.beat), numbers.astype(np.float64)
        rng = self._drawn(3)
        steps = np.full(len(numbers), self.beat)
        if rng.random() < 0.5:  # a band without a click: its tempo wanders by some percent within some bars
            walk = np.cumsum(rng.standard_normal(len(numbers)))
            walk -= np.linspace(walk[0], walk[-1], len(walk))
            steps *= 1 + rng.uniform(0.005, 0.04) * walk / max(1e-9, float(np.abs(walk).max()))
        times = np.concatenate([[0.0], np.cumsum(steps[:-1])])
        return times - times[_BEFORE] + rng.uniform(0.0, 1.5), numbers.astype(np.float64)

    def times(self, numbers: ArrayLike) -> Array:
        """Seconds of beats by number; parts of beats are interpolated."""
        times, known = self._grid
        at = np.asarray(numbers, dtype=np.float64)
        inside = np.interp(at, known, times)
        before = np.minimum(at - known[0], 0.0)
        after = np.maximum(at - known[-1], 0.0)
        return np.asarray(inside + (before + after) * self.beat)

    def beat_number(self, start: float) -> int:
        """Number of the first beat at or after `start` seconds."""
        if not self.played:
            return int(np.ceil(start / self.beat - 1e-9))
        times, known = self._grid
        return int(known[np.searchsorted(times, start - 1e-9)])

    def beats_within(self, start: float, seconds: float) -> list[float]:
        """Beats from `start` on within `seconds`, counted from `start`: what a listener taps to."""
        first = self.beat_number(start)
        found = self.times(np.arange(first, first + int(2 * seconds / self.beat) + 2)) - start
        return [round(float(at), 9) for at in found if 0 <= at < seconds]

    def section_of(self, beat: int) -> Section:
        """The section of a beat by number; beats before the song count as its first, the form repeats."""
        bar = max(beat, 0) // self.meter % sum(section.bars for section in self.form)
        for section in self.form:
            if bar < section.bars:
                return section
            bar -= section.bars
        raise AssertionError("a form has bars")

    def _drawn(self, what: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.number, 239, what])


def draw_song(
    number: int, seed: int, *, tempo: tuple[int, int], seconds: float, played: bool = False
) -> Song:
    """Song `number` of a pool: genres in shuffled rounds, each genre's tempi spread evenly over the range."""
    genres = tuple(GENRES)
    rounds, place = divmod(number, len(genres))
    order = np.random.default_rng([seed, rounds, 211]).permutation(len(genres))
    which = int(order[place])
    shift = float(np.random.default_rng([seed, which, 223]).random())
    low, high = tempo
    bpm = low + int((rounds * _GOLDEN + shift) % 1.0 * (high - low + 1))
    key = int(np.random.default_rng([seed, number, 227]).integers(12))
    return Song(number, seed, genres[which], bpm, key, seconds, played)
