"""Kinds of music and the dance that each of them asks for: the table that sound, motion and words share.

Music decides the dance: a genre names the rhythm, the harmony and the timbre of its songs, and the style of
the legs, the vocabulary of the arms, the shape of the hands and the face of whoever dances to it. The styles
are three (`step`, `bounce`, `sway`) with two genres each, which differ in their arms, so that a style can be
right where a genre is not. A song has two kinds of section; the section picks the pair of arm poses.

A rhythm is one bar of four beats in sixteenths: `x` a full hit, `o` a soft one, `.` silence.

The dancer's vocabulary, poses of the arms and moves of the legs, is written in beats: an arm or a foot is at
each place exactly on a beat. A move of the legs is four beats; its mirror image follows. What the arms of a
genre add to its own pairs has the height of those on average, high or low, by which the genre can be read
from a dance.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from motionloom.datasets.base.config import Config
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


class LegMove(Config):
    """Places of the feet on four beats, in shares of the dancer's steps; the mirror image follows.

    Each beat has (aside, forward, up, turn) of the left and of the right foot. A foot that is elsewhere on
    the next beat is lifted in between; at most one goes at a time, so that the other bears the weight.
    """

    left: tuple[tuple[float, float, float, float], ...]
    right: tuple[tuple[float, float, float, float], ...]


class _Table(Config):
    note: str
    genres: tuple[Genre, ...]
    poses: dict[str, ArmPose]
    more_arms: dict[str, str]
    """By genre, pairs of names of poses: `chest-side hips-up`."""
    freezes: dict[str, str]
    accents: dict[str, str]
    legs: dict[str, LegMove]
    legs_of: dict[Style, dict[str, float]]
    quiet_legs: dict[Style, dict[str, float]]


_TABLE = _Table.load_json(Path(__file__).with_suffix(".json"))
GENRES: dict[str, Genre] = {genre.name: genre for genre in _TABLE.genres}
"""The table; the order is part of what a seed means."""


def _pairs(words: str) -> tuple[ArmPair, ...]:
    named = (word.split("-") for word in words.split())
    return tuple((_TABLE.poses[first], _TABLE.poses[second]) for first, second in named)


MORE_ARMS = {genre: _pairs(words) for genre, words in _TABLE.more_arms.items()}
"""Pairs of poses by genre, on the even and the odd beats, beside the genre's own."""
FREEZES = {genre: _pairs(words) for genre, words in _TABLE.freezes.items()}
"""Poses of the left and the right arm in a break, by genre."""
ACCENTS = {genre: _TABLE.poses[name] for genre, name in _TABLE.accents.items()}
"""Pose of both arms on the first beat after a break, by genre."""
ARM_WAYS = ("together", "opposite", "in turn")
"""Both arms alike; one where the other was; or two beats of one arm, then two of the other."""
LEGS = _TABLE.legs
"""Moves of the legs by name. "round", a full turn within a phrase, depends on its beats."""
LEGS_OF = _TABLE.legs_of
"""Weights of the moves of the legs, by style. Only those who step lift their feet high."""
QUIET_LEGS = _TABLE.quiet_legs
"""The same where the music is quiet."""
