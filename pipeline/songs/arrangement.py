"""Arrangements: the notes of a piece, its beats, and what makes these hard to hear.

A band that plays as written says where the beat is, in its drums above all. A network that learns from such
music alone takes whatever is loud for the beat, and is sure of it. So each section of a song, of four to
sixteen bars, is played in a manner of its own: other drums (drawn freely, half-time, double-time, four to the
floor), drums of which only the back-beat or the hats are left, a kick between the beats, a bass or chords on
"and". The beats are those of the piece all the same: what is around a section tells them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from motionloom.pipeline.songs.band import (
    CRASH,
    DRUMS,
    HAT,
    KICK,
    OPEN_HAT,
    RIDE,
    SHAKER,
    SNARE,
    Note,
    perform,
)

Array = NDArray[np.float64]
STEMS = ("drums", "bass", "others")
BASSES = range(32, 40)
"""General MIDI programs."""
_KICKS = (35, 36)
_SNARES = (37, 38, 39, 40)
_AS_WRITTEN = ("all", "back-beat", "hats", "kick between")
_DRAWN = ("free", "half-time", "double-time", "four to the floor", "blast")


@dataclass(frozen=True, eq=False)
class Arrangement:
    """What is played, in seconds."""

    notes: Sequence[Note]
    programs: dict[int, int]
    """Channel -> General MIDI program from 0, of `DRUMS` the kit."""
    beats: Array
    """[K] seconds of all beats, ascending; some before 0 and behind the end."""
    downbeats: NDArray[np.bool_]
    """[K]"""

    def numbers(self) -> Array:
        """The notes' places in beats, counted from the first."""
        return np.interp([note.at for note in self.notes], self.beats, np.arange(len(self.beats)))

    def seconds(self, number: float) -> float:
        """Seconds of a place in beats."""
        return float(np.interp(number, np.arange(len(self.beats)), self.beats))

    def stems(self, seconds: float, rate: int) -> list[NDArray[np.float32]]:
        """Dry samples [seconds * rate] of each of `STEMS`; 0 where nobody plays."""
        parts: list[list[Note]] = [[], [], []]
        for note in self.notes:
            bass = self.programs.get(note.channel, 0) in BASSES
            parts[0 if note.channel == DRUMS else 1 if bass else 2].append(note)
        return [perform(part, self.programs, seconds, rate) for part in parts]


def hidden(piece: Arrangement, rng: np.random.Generator) -> Arrangement:
    """The piece with sections whose players hide the beat; about a third of them play as written."""
    numbers = piece.numbers()
    bars = [*np.flatnonzero(piece.downbeats).tolist(), len(piece.beats)]
    late = float(rng.choice([0.0, 0.0, 0.0, rng.uniform(0.05, 0.17)]))
    notes: list[Note] = []
    begun = -1  # what lies before the first bar is played as written
    while begun < len(bars) - 1:
        ended = min(len(bars) - 1, begun + int(rng.choice([4, 4, 8, 16]))) if begun >= 0 else 0
        first = bars[begun] if begun >= 0 else 0
        last = bars[ended]
        inside = (numbers >= first - 0.05) & (numbers < last - 0.05)
        section = [piece.notes[k] for k in np.flatnonzero(inside).tolist()]
        if begun >= 0 and rng.random() < 0.7:
            section = _section(piece, section, bars[begun : ended + 1], late, rng)
        notes += section
        begun = ended
    return replace(piece, notes=[note for note in notes if note.at >= 0.0])


def _section(
    piece: Arrangement, notes: Sequence[Note], bars: Sequence[int], late: float, rng: np.random.Generator
) -> list[Note]:
    """The notes of a section in a manner that is drawn; `bars` are numbers of beats, the last one its end."""
    drums = [note for note in notes if note.channel == DRUMS]
    band = [note for note in notes if note.channel != DRUMS]
    if rng.random() < 0.55:
        drums = _drawn(piece, bars, str(rng.choice(_DRAWN, p=(0.4, 0.18, 0.12, 0.2, 0.1))), late, rng)
    else:
        how = str(rng.choice(_AS_WRITTEN, p=(0.3, 0.25, 0.2, 0.25)))
        if how == "back-beat":
            drums = [note for note in drums if note.pitch in _SNARES]
        elif how == "hats":
            drums = [note for note in drums if note.pitch not in (*_KICKS, *_SNARES)]
        elif how == "kick between":
            drums = [_moved(piece, note, 0.5) if note.pitch in _KICKS else note for note in drums]
    basses = {channel for channel, program in piece.programs.items() if program in BASSES}
    moved = basses if rng.random() < 0.15 else set[int]()
    if rng.random() < 0.1:
        moved = moved | {channel for channel in piece.programs if channel not in basses}
    return drums + [_moved(piece, note, 0.5) if note.channel in moved else note for note in band]


def _moved(piece: Arrangement, note: Note, beats: float) -> Note:
    number = float(np.interp(note.at, piece.beats, np.arange(len(piece.beats))))
    return note._replace(at=piece.seconds(number + beats))


def _drawn(
    piece: Arrangement, bars: Sequence[int], how: str, late: float, rng: np.random.Generator
) -> list[Note]:
    """Drums of a section, a pattern of two bars in sixteenths; `late` delays each second eighth, in beats."""
    steps = 4 * max(1, bars[1] - bars[0] if len(bars) > 1 else 4)
    at = np.arange(2 * steps)
    beat = at % 4 == 0
    place = at % steps
    middle = at % 8 == 4 if steps % 8 == 0 else beat & (place > 0)
    # Chances of a stroke in each sixteenth.
    kick = np.where(place == 0, 0.85, np.where(beat, 0.45, np.where(at % 2 == 0, 0.3, 0.12)))
    snare = np.where(middle, 0.85, 0.05)
    if how == "half-time":
        snare = np.where(place == steps // 2, 1.0, 0.03)
    elif how == "double-time":
        kick = np.where(beat, 0.9, 0.05)
        snare = np.where(at % 4 == 2, 0.95, 0.03)
    elif how == "four to the floor":
        kick = np.where(beat, 1.0, 0.03)
        snare = np.where(middle, 0.7, 0.02)
    elif how == "blast":
        kick = np.where(at % 2 == 0, 0.9, 0.4)
        snare = np.where(at % 2 == int(rng.integers(2)), 0.9, 0.0)
    every = int(rng.choice([1, 2, 2, 4]))
    hats = at % every == 0
    if how == "four to the floor" or rng.random() < 0.25:
        hats = at % 4 == 2  # between the beats alone
    keeper = int(rng.choice([HAT, HAT, OPEN_HAT, RIDE, SHAKER]))
    strokes = [(KICK, rng.random(2 * steps) < kick, 110), (SNARE, rng.random(2 * steps) < snare, 105)]
    strokes += [(keeper, hats & (rng.random() < 0.85), 80)]
    loud = rng.uniform(0.6, 1.0)
    notes: list[Note] = []
    for bar, (first, last) in enumerate(pairwise(bars)):
        if bar == 0 and rng.random() < 0.4:
            notes.append(Note(piece.seconds(first), 0.1, DRUMS, CRASH, int(100 * loud)))
        for step in range(min(steps, 4 * (last - first))):
            when = piece.seconds(first + step / 4 + (late if step % 4 == 2 else 0.0))
            for drum, struck, velocity in strokes:
                if struck[(bar % 2) * steps + step]:
                    level = velocity * loud * rng.uniform(0.75, 1.1)
                    notes.append(Note(when, 0.1, DRUMS, drum, int(np.clip(level, 1, 127))))
    return notes
