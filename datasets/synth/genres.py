"""Kinds of music and the dance that each of them asks for: the table that sound, motion and words share.

Music decides the dance: a genre names the rhythm, the harmony and the timbre of its songs, and the style of
the legs, the vocabulary of the arms, the shape of the hands and the face of whoever dances to it. The styles
are three (`step`, `bounce`, `sway`) with two genres each, which differ in their arms, so that a style can be
right where a genre is not. A song has two kinds of section; the section picks the pair of arm poses.

A rhythm is one bar of four beats in sixteenths: `x` a full hit, `o` a soft one, `.` silence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from motionloom.datasets.synth.arms import Vec

Style = Literal["step", "bounce", "sway"]
Wave = Literal["saw", "square", "organ", "string", "bell"]
ArmPose = tuple[Vec, float, Vec]
"""Direction to the wrist (chest axes, +X outwards), reach, bend."""
ArmPair = tuple[ArmPose, ArmPose]
"""Where the arm is on the odd beats and on the even ones."""


@dataclass(frozen=True)
class Genre:
    """One line of the table."""

    name: str
    style: Style
    arms: tuple[ArmPair, ArmPair]
    """The pair of arm poses of each kind of section."""
    hand: str
    """Shape of both hands, strongest on the first beat of a bar; a name of `truth.HANDS`."""
    face: str
    """Expression, strongest on the first beat of a bar; a name of `truth.FACES`."""
    words: tuple[str, ...]
    """How captions name the music."""
    moves: tuple[str, ...]
    """How captions name the arms."""
    kick: str
    snare: str
    hat: str
    bass: str
    chord: str
    wave: Wave
    """Timbre of the chords."""
    scale: tuple[int, ...]
    """Semitones of the seven degrees above the key note."""
    progressions: tuple[tuple[int, int, int, int], tuple[int, int, int, int]]
    """Degrees (from 0) of the chords of four bars, for each kind of section."""
    octave: float
    """Octaves of the chords above 110 Hz."""
    tone: tuple[float, float, float]
    """How it is mixed: decibels below 250 Hz, from there to 2.5 kHz, and above."""
    drive: float
    """Overdrive of the mix; 1 leaves it nearly clean."""
    air: float
    """Level of steady noise: the crackle of a record, a hall."""


_MAJOR = (0, 2, 4, 5, 7, 9, 11)
_MINOR = (0, 2, 3, 5, 7, 8, 10)

GENRES: dict[str, Genre] = {
    genre.name: genre
    for genre in (
        Genre(
            "house",
            "step",
            arms=(
                (
                    ((0.1, -0.45, 0.8), 0.58, (-0.3, 1.0, 0.2)),
                    ((0.2, -0.15, 1.0), 0.84, (-0.4, 1.0, 0.1)),
                ),
                (
                    ((0.35, -0.5, 0.75), 0.6, (-0.3, 1.0, 0.3)),
                    ((0.6, -0.2, 0.8), 0.82, (-0.4, 1.0, 0.1)),
                ),
            ),
            hand="spread",
            face="surprised",
            words=("house", "house music"),
            moves=("pushing the arms forward", "with arms that push to the front"),
            kick="x...x...x...x...",
            snare="....x.......x...",
            hat="..o...o...o...o.",
            bass="..x...x...x..xx.",
            chord="..x..x....x..x..",
            wave="saw",
            scale=_MINOR,
            progressions=((0, 5, 2, 6), (0, 3, 5, 4)),
            octave=1.0,
            tone=(3.0, -6.0, 6.0),
            drive=1.2,
            air=0.0,
        ),
        Genre(
            "disco",
            "step",
            arms=(
                (((0.25, -0.85, 0.35), 0.72, (-0.2, 0.5, 1.0)), ((0.55, 0.9, 0.3), 0.93, (-0.8, 0.5, 0.0))),
                (((0.1, -0.6, 0.6), 0.6, (-0.3, 0.8, 0.6)), ((0.25, 1.0, 0.2), 0.95, (-0.8, 0.4, 0.0))),
            ),
            hand="point",
            face="happy",
            words=("disco", "disco music"),
            moves=("throwing the arms up", "with arms thrown up high"),
            kick="x...x...x...x...",
            snare="....x.......x...",
            hat="xoxoxoxoxoxoxoxo",
            bass="x.x.x.x.x.x.x.x.",
            chord="x.......x.......",
            wave="string",
            scale=_MAJOR,
            progressions=((0, 5, 3, 4), (3, 4, 2, 5)),
            octave=2.0,
            tone=(-6.0, 4.0, 6.0),
            drive=1.0,
            air=0.002,
        ),
        Genre(
            "hiphop",
            "bounce",
            arms=(
                (
                    ((0.35, -0.85, 0.45), 0.66, (-0.3, 0.6, 1.0)),
                    ((-0.15, -0.6, 0.85), 0.62, (-0.2, 1.0, 0.3)),
                ),
                (
                    ((0.45, -0.9, 0.25), 0.8, (-0.2, 0.4, 1.0)),
                    ((0.05, -0.7, 0.75), 0.66, (-0.3, 0.9, 0.4)),
                ),
            ),
            hand="pinch",
            face="angry",
            words=("hip hop", "hip hop music", "a rap beat"),
            moves=("swinging the arms low across the body", "crossing low arms in front"),
            kick="x.....x..xx.....",
            snare="....x.......x..o",
            hat="x.o.x.o.x.oox.o.",
            bass="x.....x..x......",
            chord="x...............",
            wave="bell",
            scale=_MINOR,
            progressions=((0, 0, 5, 5), (0, 5, 3, 4)),
            octave=2.0,
            tone=(8.0, -2.0, -14.0),
            drive=1.3,
            air=0.012,
        ),
        Genre(
            "rock",
            "bounce",
            arms=(
                (((0.45, 0.15, 0.55), 0.52, (-0.6, 0.8, 0.0)), ((0.35, 0.95, 0.3), 0.88, (-0.8, 0.5, 0.0))),
                (((0.8, 0.2, 0.35), 0.58, (-0.6, 0.8, 0.0)), ((0.7, 0.8, 0.25), 0.88, (-0.8, 0.5, 0.0))),
            ),
            hand="fist",
            face="angry",
            words=("rock", "rock music"),
            moves=("pumping the arms overhead", "with arms that pump in the air"),
            kick="x.......x.x.....",
            snare="....x.......x...",
            hat="x.o.x.o.x.o.x.o.",
            bass="x.x.x.x.x.x.x.x.",
            chord="x.x.x.x.x.x.x.x.",
            wave="square",
            scale=_MAJOR,
            progressions=((0, 4, 5, 3), (5, 3, 0, 4)),
            octave=0.0,
            tone=(-2.0, 6.0, 0.0),
            drive=4.0,
            air=0.0,
        ),
        Genre(
            "ballad",
            "sway",
            arms=(
                (((0.95, -0.3, 0.25), 0.88, (-0.2, 0.8, 0.5)), ((0.95, 0.3, 0.25), 0.92, (-0.4, 0.8, 0.2))),
                (((1.0, 0.0, 0.35), 0.9, (-0.2, 0.8, 0.5)), ((0.8, 0.6, 0.3), 0.9, (-0.5, 0.8, 0.1))),
            ),
            hand="wave_fingers",
            face="sad",
            words=("a ballad", "slow romantic music"),
            moves=("waving wide arms", "with the arms spread wide"),
            kick="x...o...o...o...",
            snare="................",
            hat="o...o...o...o...",
            bass="x.......x.......",
            chord="x.o.o.o.x.o.o.o.",
            wave="string",
            scale=_MAJOR,
            progressions=((0, 2, 5, 3), (5, 3, 0, 4)),
            octave=1.0,
            tone=(-2.0, 4.0, -12.0),
            drive=0.8,
            air=0.0005,
        ),
        Genre(
            "reggae",
            "sway",
            arms=(
                (
                    ((0.3, -0.95, -0.15), 0.92, (-0.1, 0.2, 1.0)),
                    ((0.25, -0.9, 0.45), 0.92, (-0.1, 0.4, 1.0)),
                ),
                (
                    ((0.3, -0.95, 0.25), 0.78, (-0.1, 0.4, 1.0)),
                    ((0.6, -0.8, 0.25), 0.86, (-0.1, 0.4, 1.0)),
                ),
            ),
            hand="spread",
            face="happy",
            words=("reggae", "reggae music"),
            moves=("letting the arms swing low", "with low loose arms"),
            kick="o...o...x...o...",
            snare="........x.......",
            hat="x..ox..ox..ox..o",
            bass="..x.x.....x.x.x.",
            chord="....x.......x...",
            wave="organ",
            scale=_MAJOR,
            progressions=((0, 3, 0, 4), (0, 1, 3, 0)),
            octave=1.0,
            tone=(6.0, 2.0, -5.0),
            drive=1.0,
            air=0.0,
        ),
    )
}
"""The table; the order is part of what a seed means."""
