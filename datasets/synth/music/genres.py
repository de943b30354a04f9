"""Kinds of music and the dance that each of them asks for: the table that sound, motion and words share.

Music decides the dance: a genre names the rhythm, the harmony and the timbre of its songs, and the style of
the legs, the vocabulary of the arms, the shape of the hands and the face of whoever dances to it. The styles
are three (`step`, `bounce`, `sway`) with two genres each, which differ in their arms, so that a style can be
right where a genre is not. A song has two kinds of section; the section picks the pair of arm poses.

A rhythm is one bar of four beats in sixteenths: `x` a full hit, `o` a soft one, `.` silence.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from motionloom.datasets.schema import Config
from motionloom.datasets.synth.actions.arms import Vec

Style = Literal["step", "bounce", "sway"]
Wave = Literal["saw", "square", "organ", "string", "bell"]
ArmPose = tuple[Vec, float, Vec]
"""Direction to the wrist (chest axes, +X outwards), reach, bend."""
ArmPair = tuple[ArmPose, ArmPose]
"""Poses of the arm on the odd beats and on the even ones."""

_SCALES = {"major": (0, 2, 4, 5, 7, 9, 11), "minor": (0, 2, 3, 5, 7, 8, 10)}


class Genre(Config):
    """One entry of `genres.json`."""

    name: str
    style: Style
    arms: tuple[ArmPair, ArmPair]
    """The pair of arm poses of each kind of section."""
    hand: str
    """Shape of both hands, strongest on the first beat of a bar; a name of `actions.hands.HANDS`."""
    face: str
    """Expression, strongest on the first beat of a bar; a name of `motion.body.expressions.FACES`."""
    words: tuple[str, ...]
    """Names of the music in captions."""
    moves: tuple[str, ...]
    """Names of the arms' moves in captions."""
    kick: str
    snare: str
    hat: str
    bass: str
    chord: str
    wave: Wave
    """Timbre of the chords."""
    scale: Literal["major", "minor"]
    progressions: tuple[tuple[int, int, int, int], tuple[int, int, int, int]]
    """Degrees (from 0) of the chords of four bars, for each kind of section."""
    octave: float
    """Octaves of the chords above 110 Hz."""
    tone: tuple[float, float, float]
    """Mix in decibels: below 250 Hz, from there to 2.5 kHz, and above."""
    drive: float
    """Overdrive of the mix; 1 leaves it nearly clean."""
    air: float
    """Level of steady noise: the crackle of a record, a hall."""

    def semitones(self, degree: int) -> int:
        """Semitones of a degree (from 0; 7 is the octave) above the key note."""
        octave, step = divmod(degree, 7)
        return 12 * octave + _SCALES[self.scale][step]


class _Table(Config):
    note: str
    genres: tuple[Genre, ...]


GENRES: dict[str, Genre] = {
    genre.name: genre for genre in _Table.load_json(Path(__file__).with_suffix(".json")).genres
}
"""The table; the order is part of what a seed means."""
