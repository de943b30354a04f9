"""Pieces that people composed: excerpts of MIDI files, whose beats the file itself counts.

Beats are those of its time signatures and tempi, halved or doubled into 60 to 190 a minute. In one that
was played freely beside its metronome they mean nothing: its notes lie anywhere, and it is left out, as is
one that is counted between its beats. Each excerpt is arranged anew: faster or slower, in another key, by
other instruments of the same families, with some of them silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.actions.maths import Array
from motionloom.datasets.synth.music.band import DRUMS, Instruments, Stroke

SLOWEST, FASTEST = 60.0, 190.0
"""Beats a minute."""
ON_BEAT = 0.35
"""Least share of the notes within an eighth of a beat of one; a quarter is what chance gives."""
SHORTEST = 30.0
"""Seconds of a piece that excerpts are taken from."""


@dataclass(frozen=True, eq=False)
class Score:
    """A MIDI file in seconds."""

    messages: tuple[tuple[float, Any], ...]
    """Seconds, and mido's message."""
    beats: Array
    """[K] seconds."""
    downbeats: NDArray[np.bool_]
    """[K]"""
    first: float
    """Seconds of the first note."""

    @property
    def counted(self) -> bool:
        """Whether it is long enough and enough of its notes are on its beats, more than between two."""
        if len(self.beats) < 9 or self.beats[-1] - self.first < SHORTEST:
            return False
        struck = np.array([at for at, message in self.messages if _struck(message)])
        numbers = np.interp(struck[struck < self.beats[-1]], self.beats, np.arange(len(self.beats)))
        away = np.abs(numbers - np.round(numbers))
        on, between = float(np.mean(away < 0.125)), float(np.mean(away > 0.375))
        return on >= ON_BEAT and on > between


@lru_cache(maxsize=4)
def scores(folder: Path) -> tuple[Score, ...]:
    """Pieces of a folder, in the order of their names, without those that are short or have no beats."""
    found = [read_score(path) for path in sorted(folder.rglob("*.mid"))]
    kept = tuple(score for score in found if score.counted)
    if not kept:
        raise UserError(f"{folder}: no MIDI file (*.mid) of half a minute whose notes are on its beats")
    return kept


def read_score(path: Path) -> Score:
    """A MIDI file; `UserError` for what is none."""
    try:
        import mido

        file = mido.MidiFile(path, clip=True)
        track = mido.merge_tracks(file.tracks)
    except ImportError:
        raise UserError("reading MIDI files needs mido: pip install 'motionloom[band]'") from None
    except (OSError, EOFError, ValueError, KeyError, IndexError) as error:
        raise UserError(f"{path}: no MIDI file ({error})") from None
    now, ticks, tempo = 0.0, 0, 500_000
    tempi, meters, messages = [(0, 0.0)], [(0, file.ticks_per_beat, 4)], []
    for message in track:
        now += mido.tick2second(message.time, file.ticks_per_beat, tempo)
        ticks += message.time
        tempi.append((ticks, now))
        if message.type == "set_tempo":
            tempo = message.tempo
        elif message.type == "time_signature":
            unit, count = 4 * file.ticks_per_beat // message.denominator, message.numerator
            if message.denominator == 8 and count % 3 == 0:
                unit, count = 3 * unit, count // 3
            meters.append((ticks, max(1, unit), max(1, count)))
        elif not message.is_meta:
            messages.append((now, message))
    starts = [at for at, _, _ in meters[1:]] + [ticks]
    counted = [
        (tick, place % count == 0)
        for (start, unit, count), end in zip(meters, starts, strict=True)
        for place, tick in enumerate(range(start, end, unit))
    ]
    known, seconds = (np.array(column) for column in zip(*tempi, strict=True))
    beats = np.interp([tick for tick, _ in counted], known, seconds)
    downbeats = np.array([down for _, down in counted], dtype=np.bool_)
    first = next((at for at, message in messages if _struck(message)), now)
    return Score(tuple(messages), *_moderate(beats, downbeats), first)


def excerpt(
    score: Score, seconds: float, rate: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_]]:
    """Dry samples [seconds * rate] of a part of a piece in an arrangement of its own, beats and downbeats."""
    last = float(score.beats[-1])
    speed = min(float(np.exp(rng.uniform(-0.2, 0.2))), (last - score.first) / seconds)
    start = float(rng.uniform(score.first, last - speed * seconds))
    key = int(rng.integers(-5, 6))
    swapped = rng.integers(8, size=16)
    silent = rng.random(16) < np.where(np.arange(16) == DRUMS, 0.15, 0.2)
    if silent[list({message.channel for _, message in score.messages if _struck(message)})].all():
        silent[:] = False
    others = rng.random() < 0.5
    band = Instruments(rate)
    strokes: list[Stroke] = []
    for at, message in score.messages:
        when = max(0.0, (at - start) / speed)
        kind, channel = message.type, getattr(message, "channel", 0)
        if kind == "program_change":
            program = message.program
            if others:
                program = 0 if channel == DRUMS else program // 8 * 8 + int(swapped[channel])
            strokes.append((when, 0, partial(band.select, channel, program)))
        elif kind == "control_change":
            strokes.append((when, 1, partial(band.synth.cc, channel, message.control, message.value)))
        elif kind == "pitchwheel":
            strokes.append((when, 1, partial(band.synth.pitch_bend, channel, message.pitch)))
        elif kind in ("note_on", "note_off") and at >= start and not silent[channel]:
            pitch = int(np.clip(message.note + (0 if channel == DRUMS else key), 0, 127))
            if _struck(message):
                strokes.append((when, 3, partial(band.synth.noteon, channel, pitch, message.velocity)))
            else:
                strokes.append((when, 2, partial(band.synth.noteoff, channel, pitch)))
    for channel in range(16):
        band.select(channel, 0)
    beats = (score.beats - start) / speed
    inside = (beats >= 0) & (beats < seconds)
    return band.play(strokes, seconds), beats[inside], score.downbeats[inside]


def _struck(message: Any) -> bool:
    return bool(message.type == "note_on" and message.velocity > 0)


def _moderate(beats: Array, downbeats: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Every second beat of a fast count, and beats between those of a slow one."""
    if len(beats) < 3:
        return beats, downbeats
    pace = 60.0 / float(np.median(np.diff(beats)))
    if pace > FASTEST:
        even = (np.arange(len(beats)) - int(np.argmax(downbeats))) % 2 == 0
        return beats[even], downbeats[even]
    if pace < SLOWEST:
        between = np.sort(np.concatenate([beats, (beats[1:] + beats[:-1]) / 2]))
        both = np.zeros(len(between), dtype=np.bool_)
        both[::2] = downbeats
        return between, both
    return beats, downbeats
