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

from dataclasses import dataclass
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

POSES: dict[str, ArmPose] = {
    "down": ((0.3, -0.95, 0.25), 0.86, (-0.1, 0.4, 1.0)),
    "back": ((0.35, -0.95, -0.25), 0.9, (-0.1, 0.2, 1.0)),
    "hips": ((0.3, -1.0, 0.12), 0.7, (-1.0, 0.1, 0.3)),
    "chest": ((-0.05, -0.4, 0.9), 0.5, (-0.4, 0.9, 0.2)),
    "belly": ((-0.05, -0.8, 0.75), 0.6, (-0.4, 0.9, 0.2)),
    "cross": ((-0.4, -0.5, 0.85), 0.6, (-0.2, 1.0, 0.3)),
    "front": ((0.1, -0.2, 1.0), 0.86, (-0.4, 1.0, 0.1)),
    "low_side": ((0.9, -0.75, 0.25), 0.9, (-0.2, 0.6, 0.8)),
    "side": ((1.0, -0.05, 0.25), 0.92, (-0.3, 0.8, 0.4)),
    "shoulder": ((0.5, 0.15, 0.55), 0.52, (-0.6, 0.8, 0.0)),
    "head": ((0.75, 0.7, 0.1), 0.5, (-0.8, 0.5, 0.2)),
    "wide_up": ((0.75, 0.8, 0.25), 0.92, (-0.8, 0.5, 0.0)),
    "up": ((0.25, 1.0, 0.25), 0.94, (-0.8, 0.5, 0.0)),
}
"""Poses of an arm by name."""

_MORE: dict[str, str] = {
    "house": "chest-low_side cross-side belly-front hips-front hips-side chest-belly",
    "disco": "chest-up side-up hips-up head-wide_up shoulder-side belly-wide_up",
    "hiphop": "hips-front cross-low_side belly-front chest-belly down-side hips-chest",
    "rock": "side-up head-up shoulder-side chest-wide_up up-wide_up chest-up",
    "ballad": "side-up chest-side belly-wide_up head-side cross-wide_up low_side-wide_up",
    "reggae": "hips-low_side back-belly down-cross hips-down back-low_side down-belly",
}
_FREEZES: dict[str, str] = {
    "house": "hips-hips cross-cross front-hips",
    "disco": "up-hips hips-up head-head",
    "hiphop": "cross-cross hips-down chest-hips",
    "rock": "up-hips head-head shoulder-shoulder",
    "ballad": "side-side chest-wide_up wide_up-chest",
    "reggae": "hips-hips back-back down-hips",
}


def _pairs(words: str) -> tuple[ArmPair, ...]:
    named = (word.split("-") for word in words.split())
    return tuple((POSES[first], POSES[second]) for first, second in named)


MORE_ARMS: dict[str, tuple[ArmPair, ...]] = {genre: _pairs(words) for genre, words in _MORE.items()}
"""Pairs of poses by genre, on the even and the odd beats, beside the genre's own."""
FREEZES: dict[str, tuple[ArmPair, ...]] = {genre: _pairs(words) for genre, words in _FREEZES.items()}
"""Poses of the left and the right arm in a break, by genre."""
ACCENTS: dict[str, ArmPose] = {
    genre: POSES["wide_up" if genre in ("disco", "rock", "ballad") else "side"] for genre in _MORE
}
"""Pose of both arms on the first beat after a break, by genre."""

ARM_WAYS = ("together", "opposite", "in turn")
"""Both arms alike; one where the other was; or two beats of one arm, then two of the other."""


@dataclass(frozen=True)
class LegMove:
    """Places of the feet on four beats, in shares of the dancer's steps; the mirror image follows.

    Each beat has (aside, forward, up, turn) of the left and of the right foot. A foot that is elsewhere on
    the next beat is lifted in between; at most one goes at a time, so that the other bears the weight.
    """

    left: tuple[tuple[float, float, float, float], ...]
    right: tuple[tuple[float, float, float, float], ...]


_HOME = (0.0, 0.0, 0.0, 0.0)
_ASIDE = (1.0, 0.0, 0.0, 0.0)
_FORWARD = (0.0, 1.0, 0.0, 0.0)
_BACK = (0.0, -0.8, 0.0, 0.0)
_UP = (0.0, 0.25, 1.0, 0.0)
_TURNED = (0.0, 0.0, 0.0, 1.0)
_HALF_ASIDE = (-0.7, 0.0, 0.0, 0.0)

LEGS: dict[str, LegMove] = {
    "stand": LegMove((_HOME,) * 4, (_HOME,) * 4),
    "side": LegMove((_HOME, _ASIDE, _ASIDE, _ASIDE), (_HOME, _HOME, _ASIDE, _HOME)),
    "touch": LegMove((_HOME, _ASIDE, _HOME, _HOME), (_HOME, _HOME, _HOME, _HALF_ASIDE)),
    "forward": LegMove((_HOME, _FORWARD, _FORWARD, _FORWARD), (_HOME, _HOME, _FORWARD, _HOME)),
    "rock": LegMove((_HOME, _FORWARD, _HOME, _HOME), (_HOME, _HOME, _HOME, _BACK)),
    "knees": LegMove((_HOME, _UP, _HOME, _HOME), (_HOME, _HOME, _HOME, _UP)),
    "turn": LegMove((_HOME, _TURNED, _TURNED, _TURNED), (_HOME, _HOME, _TURNED, _HOME)),
}
"""Moves of the legs by name. "round", a full turn within a phrase, depends on its beats."""

LEGS_OF: dict[Style, dict[str, float]] = {
    "step": {"side": 4.0, "touch": 1.5, "forward": 1.5, "rock": 1.0, "knees": 1.5, "turn": 1.5},
    "bounce": {"stand": 4.0, "touch": 1.5, "rock": 1.0, "forward": 0.8, "turn": 1.2},
    "sway": {"stand": 4.0, "touch": 1.5, "forward": 1.2, "rock": 0.8, "turn": 1.0},
}
"""Weights of the moves of the legs, by style. Only those who step lift their feet high."""

QUIET_LEGS: dict[Style, dict[str, float]] = {
    "step": {"touch": 2.0, "side": 1.0, "rock": 1.0},
    "bounce": {"stand": 3.0, "touch": 1.0},
    "sway": {"stand": 3.0, "touch": 1.0},
}
"""The same where the music is quiet."""
