"""Pieces that people composed: excerpts of MIDI files, whose beats the file itself counts.

Beats are those of its time signatures and tempi, halved or doubled into 60 to 190 a minute. In a piece that
was played freely beside its metronome they mean nothing: its notes lie anywhere, and it is left out, as is
one that is counted between its beats. Each excerpt is arranged anew: faster or slower, in another key, by
other instruments of the same families, with some of them silent. Files are `*.mid` and the music in `*.wad`.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.songs.arrangement import Arrangement
from motionloom.pipeline.songs.band import DRUMS, Note

Array = NDArray[np.float64]
SLOWEST, FASTEST = 60.0, 190.0
"""Beats a minute."""
ON_BEAT = 0.35
"""Least share of the notes within an eighth of a beat of one; a quarter is what chance gives."""
SHORTEST = 30.0
"""Seconds of a piece that excerpts are taken from."""


@dataclass(frozen=True, eq=False)
class Score:
    """A MIDI file in seconds."""

    name: str
    notes: tuple[Note, ...]
    """By their times."""
    programs: tuple[tuple[float, int, int], ...]
    """(seconds, channel, program) of each change."""
    beats: Array
    """[K] seconds."""
    downbeats: NDArray[np.bool_]
    """[K]"""

    @property
    def counted(self) -> bool:
        """Whether it is long enough and enough of its notes are on its beats, more than between two."""
        if not self.notes or len(self.beats) < 9 or self.beats[-1] - self.notes[0].at < SHORTEST:
            return False
        struck = np.array([note.at for note in self.notes])
        numbers = np.interp(struck[struck < self.beats[-1]], self.beats, np.arange(len(self.beats)))
        away = np.abs(numbers - np.round(numbers))
        on = float(np.mean(away < 0.125))
        between = float(np.mean(away > 0.375))
        return on >= ON_BEAT and on > between


@lru_cache(maxsize=4)
def scores(places: tuple[Path, ...]) -> tuple[Score, ...]:
    """Pieces of these files and folders, by their names, without those that are short or have no beats.

    `UserError` where a place is missing, a file is no MIDI file, or no piece is left.
    """
    kept = []
    for place in places:
        if not place.exists():
            raise UserError(
                f"{place}: no such MIDI files; Debian has them (apt install freedoom "
                f"planetblupi-music-midi), or train without: --set songs.scores=[]"
            )
        files = [place] if place.is_file() else sorted(place.rglob("*"))
        pieces = [piece for file in files for piece in _read(file)]
        kept += [piece for piece in map(_moderate, pieces) if piece.counted]
    if not kept:
        raise UserError(f"{places[0]}: no MIDI file of half a minute with notes on its beats; name others")
    return tuple(kept)


def _read(path: Path) -> Iterator[Score]:
    """The pieces of a file of a known kind, each once."""
    if path.suffix.lower() == ".mid":
        yield read_score(path.read_bytes(), str(path))
    elif path.suffix.lower() == ".wad":
        data = path.read_bytes()
        _, count, at = struct.unpack("<4sii", data[:12])
        seen = set()
        for start, size, name in struct.iter_unpack("<ii8s", data[at : at + 16 * count]):
            piece = data[start : start + size]
            if piece[:4] == b"MThd" and piece not in seen:
                seen.add(piece)
                yield read_score(piece, f"{path}: {name.rstrip(bytes(1)).decode()}")


def read_score(data: bytes, name: str) -> Score:
    """A MIDI file's bytes, its beats as it counts them; `UserError` for what is none."""
    try:
        import mido

        file = mido.MidiFile(file=io.BytesIO(data), clip=True)
        track = mido.merge_tracks(file.tracks)
    except ImportError:
        raise UserError("reading MIDI files needs mido: pip install 'motionloom[band]'") from None
    except (OSError, EOFError, ValueError, KeyError, IndexError) as error:
        raise UserError(f"{name}: no MIDI file ({error}); leave it out") from None
    quarter = file.ticks_per_beat
    now = 0.0
    ticks = 0
    tempo = 500_000
    tempi = [(0, 0.0)]
    meters = [(0, quarter, 4)]
    notes: list[Note] = []
    programs: list[tuple[float, int, int]] = []
    sounding: dict[tuple[int, int], tuple[float, int]] = {}
    levels = np.ones((16, 128))  # of the controllers that make a channel louder or softer
    for message in track:
        now += mido.tick2second(message.time, quarter, tempo)
        ticks += message.time
        tempi.append((ticks, now))
        if message.type == "set_tempo":
            tempo = message.tempo
        elif message.type == "time_signature":
            meters.append((ticks, *_bar(message.numerator, message.denominator, quarter)))
        elif message.type == "program_change":
            programs.append((now, message.channel, message.program))
        elif message.type == "control_change" and message.control in (7, 11):
            levels[message.channel, message.control] = message.value / (100 if message.control == 7 else 127)
        elif message.type in ("note_on", "note_off"):
            key = (message.channel, message.note)
            if key in sounding:
                start, loud = sounding.pop(key)
                notes.append(Note(start, max(0.05, now - start), *key, loud))
            if message.type == "note_on" and message.velocity > 0:
                loud = message.velocity * levels[message.channel, 7] * levels[message.channel, 11]
                sounding[key] = (now, int(np.clip(loud, 1, 127)))
    counted = list(_counted(meters, ticks))
    known, seconds = (np.array(column) for column in zip(*tempi, strict=True))
    beats = np.interp([tick for tick, _ in counted], known, seconds)
    downbeats = np.array([down for _, down in counted], dtype=np.bool_)
    return Score(name, tuple(sorted(notes)), tuple(programs), beats, downbeats)


def excerpt(score: Score, seconds: float, rng: np.random.Generator) -> Arrangement:
    """A part of a piece, so many seconds from a place that is drawn, in an arrangement of its own."""
    first = score.notes[0].at
    last = float(score.beats[-1])
    speed = min(float(np.exp(rng.uniform(-0.2, 0.2))), (last - first) / seconds)
    start = float(rng.uniform(first, last - speed * seconds))
    key = int(rng.integers(-5, 6))
    swapped = rng.integers(8, size=16)
    others = rng.random() < 0.5
    silent = rng.random(16) < np.where(np.arange(16) == DRUMS, 0.15, 0.2)
    inside = [note for note in score.notes if start <= note.at < start + speed * seconds]
    if silent[list({note.channel for note in inside})].all():
        silent[:] = False
    programs = dict.fromkeys(range(16), 0)
    for at, channel, program in score.programs:
        if at <= start + speed * seconds / 2:
            programs[channel] = program
    if others:
        for channel, program in programs.items():
            programs[channel] = program // 8 * 8 + int(swapped[channel])
    programs[DRUMS] = int(rng.choice([0, 8, 16, 24, 25, 32, 40]))
    notes = [
        note._replace(
            at=(note.at - start) / speed,
            seconds=note.seconds / speed,
            pitch=note.pitch if note.channel == DRUMS else int(np.clip(note.pitch + key, 0, 127)),
        )
        for note in inside
        if not silent[note.channel]
    ]
    beats = (score.beats - start) / speed
    near = (beats > -4.0) & (beats < seconds + 4.0)
    return Arrangement(notes, programs, beats[near], score.downbeats[near])


def _bar(count: int, denominator: int, quarter: int) -> tuple[int, int]:
    """Ticks of a beat and beats of a bar of a time signature; of 6/8 a beat is three eighths."""
    unit = 4 * quarter // denominator
    if denominator == 8 and count % 3 == 0:
        return max(1, 3 * unit), max(1, count // 3)
    return max(1, unit), max(1, count)


def _counted(meters: Sequence[tuple[int, int, int]], end: int) -> Iterator[tuple[int, bool]]:
    """Ticks of the beats by (tick, ticks of a beat, beats of a bar), and whether each begins a bar."""
    starts = [at for at, _, _ in meters[1:]] + [end]
    for (start, unit, count), stop in zip(meters, starts, strict=True):
        for place, tick in enumerate(range(start, stop, unit)):
            yield tick, place % count == 0


def _moderate(score: Score) -> Score:
    """The piece with every second beat of a fast count, or beats between those of a slow one."""
    beats = score.beats
    downbeats = score.downbeats
    if len(beats) < 3:
        return score
    pace = 60.0 / float(np.median(np.diff(beats)))
    if pace > FASTEST:
        even = (np.arange(len(beats)) - int(np.argmax(downbeats))) % 2 == 0
        return replace(score, beats=beats[even], downbeats=downbeats[even])
    if pace < SLOWEST:
        between = np.sort(np.concatenate([beats, (beats[1:] + beats[:-1]) / 2]))
        both = np.zeros(len(between), dtype=np.bool_)
        both[::2] = downbeats
        return replace(score, beats=between, downbeats=both)
    return score
