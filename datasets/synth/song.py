"""Songs: pieces of music with a genre, a tempo, a key and sections, to which several dances are danced.

A song is a pure function of (seed, number, options). Its first beat lies at 0 and its bars have four beats;
sections of four bars alternate between two kinds, A and B, which differ in chords, in density and in an upper
voice, and for the dancer in the arms. `render_song` plays it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.synth import instruments
from motionloom.datasets.synth.genres import GENRES, Genre
from motionloom.datasets.synth.maths import Array

BEATS = 4
"""Beats of a bar."""
SECTION_BARS = 4
"""Bars of a section."""
_GOLDEN = 0.6180339887498949
_LEVEL = {"x": 1.0, "o": 0.45}


@dataclass(frozen=True)
class Song:
    """One piece of music."""

    number: int
    seed: int
    genre: str
    bpm: int
    key: int
    """Semitones of the key note above A."""
    seconds: float

    @property
    def beat(self) -> float:
        """Seconds of a beat."""
        return 60.0 / self.bpm

    @property
    def style(self) -> Genre:
        """Its line of the table of genres."""
        return GENRES[self.genre]

    def beat_times(self) -> Array:
        """Seconds of all beats; every fourth from the first on begins a bar."""
        return np.asarray(np.arange(int(np.ceil(self.seconds / self.beat - 1e-9))) * self.beat)

    def section(self, beat: int) -> int:
        """Kind of section (0 is A, 1 is B) of a beat by number; beats before the song count as its first."""
        return (max(beat, 0) // (BEATS * SECTION_BARS)) % 2

    def record(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {"song": self.number, "genre": self.genre, "bpm": self.bpm, "key": self.key}


def draw_song(
    number: int, seed: int, *, genres: tuple[str, ...], tempo: tuple[int, int], seconds: float
) -> Song:
    """Song `number` of a pool: genres in shuffled rounds, each genre's tempi spread evenly over the range."""
    rounds, place = divmod(number, len(genres))
    order = np.random.default_rng([seed, rounds, 211]).permutation(len(genres))
    which = int(order[place])
    shift = float(np.random.default_rng([seed, which, 223]).random())
    low, high = tempo
    bpm = low + int((rounds * _GOLDEN + shift) % 1.0 * (high - low + 1))
    key = int(np.random.default_rng([seed, number, 227]).integers(12))
    return Song(number, seed, genres[which], bpm, key, seconds)


@lru_cache(maxsize=64)
def render_song(song: Song, rate: int) -> NDArray[np.float32]:
    """The whole song as mono samples [seconds * rate] in -1..1; read-only, the same bytes each time."""
    total = round(song.seconds * rate)
    rng = np.random.default_rng([song.seed, song.number, 229])
    genre = song.style
    out = np.zeros(total + rate)
    drums = (
        (genre.kick, instruments.kick(rate), 0.55),
        (genre.snare, instruments.snare(rate, rng), 0.4),
        (genre.hat, instruments.hat(rate, rng), 0.2),
        # Every beat can be heard in every genre, and which of them begins a bar.
        ("x...............", instruments.tick(rate, rng, high=True), 0.5),
        ("....x...x...x...", instruments.tick(rate, rng, high=False), 0.4),
    )
    bars = int(np.ceil(song.seconds / (BEATS * song.beat)))
    sixteenth = song.beat / 4
    for bar in range(bars):
        kind = song.section(bar * BEATS)
        begin = bar * BEATS * song.beat
        for pattern, sound, loud in drums:
            for step, level in _hits(pattern):
                _add(out, round((begin + step * sixteenth) * rate), sound, loud * level)
        if kind:  # B is denser: an open hat between the beats
            for step in (2, 6, 10, 14):
                _add(out, round((begin + step * sixteenth) * rate), drums[2][1], 0.1)
        degree = genre.progressions[kind][bar % 4]
        _harmony(out, song, degree, kind, begin, rate)
    out = out[:total] + genre.air * rng.standard_normal(total)
    out = instruments.equalize(out, rate, genre.tone)
    # A soft limiter; driven hard it is the distortion of rock.
    out = 0.95 * np.tanh(genre.drive * out)
    samples = np.asarray(out, dtype=np.float32)
    samples.setflags(write=False)
    return samples


def _harmony(out: Array, song: Song, degree: int, kind: int, begin: float, rate: int) -> None:
    """Bass, chord and, in section B, an upper voice of one bar that begins at `begin` seconds."""
    genre, sixteenth = song.style, song.beat / 4
    root = 55.0 * 2 ** ((song.key + _degree(genre, degree)) / 12)
    for place, (step, gap, level) in enumerate(_notes(genre.bass)):
        # Octaves in turn are what makes a disco bass.
        up = 2.0 if genre.name == "disco" and place % 2 else 1.0
        sound = instruments.bass(rate, root * up, min(gap, 8) * sixteenth)
        _add(out, round((begin + step * sixteenth) * rate), sound, 0.34 * level)
    base = 110.0 * 2 ** (genre.octave + song.key / 12 - (1.0 if song.key > 6 else 0.0))
    tones = [base * 2 ** (_degree(genre, degree + third) / 12) for third in (0, 2, 4)]
    for place, (step, gap, level) in enumerate(_notes(genre.chord)):
        at = round((begin + step * sixteenth) * rate)
        # A ballad breaks its chords, the others strike them.
        chosen = [tones[place % 3]] if genre.name == "ballad" else tones
        for hertz in chosen:
            loud = (0.5 if len(chosen) == 1 else 0.26) * level
            _add(out, at, instruments.note(rate, genre.wave, hertz, gap * sixteenth), loud)
    if kind:
        for beat in range(BEATS):
            hertz = 2 * tones[beat % 3]
            sound = instruments.note(rate, genre.wave, hertz, song.beat)
            _add(out, round((begin + beat * song.beat) * rate), sound, 0.2)


def _degree(genre: Genre, degree: int) -> int:
    """Semitones of a degree (from 0; 7 is the octave) above the key note."""
    octave, step = divmod(degree, 7)
    return 12 * octave + genre.scale[step]


def _hits(pattern: str) -> list[tuple[int, float]]:
    return [(step, _LEVEL[sign]) for step, sign in enumerate(pattern) if sign != "."]


def _notes(pattern: str) -> list[tuple[int, int, float]]:
    """(sixteenth, sixteenths to the next note, level) of a bar's notes."""
    hits = _hits(pattern)
    ends = [*(step for step, _ in hits[1:]), 16]
    return [(step, end - step, level) for (step, level), end in zip(hits, ends, strict=True)]


def _add(out: Array, at: int, sound: Array, level: float) -> None:
    end = min(len(out), at + len(sound))
    if at < end:
        out[at:end] += level * sound[: end - at]
