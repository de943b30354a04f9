"""A band that plays songs, with the sounds of real instruments: FluidSynth with a General MIDI sound font.

Needs `pip install 'motionloom[band]'`, the library FluidSynth and a sound font: the file that
`MOTIONLOOM_SOUND_FONT` names, or FluidR3 (MIT licence; Debian's `fluid-soundfont-gm`).

What it plays is a pure function of the song: a line-up (a whole drum kit, one that leaves out beats, hats or
hands alone, none at all), a feel (straight, swung, half-time, double-time, syncopated), harmony, bass, pads,
melodies and choirs that come and go with the energy of each section, fills before sections, and the small
unevenness of hands. In a break one chord rings. Beats are those of the song's grid, whoever plays on them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.synth.music.song import Section, Song

SOUND_FONT = Path("/usr/share/sounds/sf2/FluidR3_GM.sf2")
DRUMS = 9
"""The channel of drums."""
_DRUM_BANK = 128

KICK = 36
SNARE = 38
_CLAP = 39
HAT = 42
OPEN_HAT = 46
CRASH = 49
RIDE = 51
SHAKER = 70
_RIM = 37
_TOMS = (50, 48, 45, 43)
_BASS, _CHORDS, _PAD, _LEAD = range(4)
_PROGRAMS = {
    # General MIDI numbers from 0: basses; pianos, guitars and organs; strings, choirs and pads; leads.
    _BASS: (32, 33, 34, 35, 36, 38, 39),
    _CHORDS: (0, 1, 4, 5, 16, 18, 24, 25, 26, 27, 28, 29, 30, 11),
    _PAD: (48, 49, 50, 52, 53, 89, 90, 91),
    _LEAD: (40, 56, 57, 61, 64, 65, 66, 71, 73, 80, 81, 85, 53, 22),
}
_SOFT_HANDS = 0.006
"""Seconds that hands are early or late, standard deviation."""


def band_version() -> str:
    """Return the checksum of the sound font; `UserError` where no band can play."""
    _fluidsynth()
    return sha256_of(sound_font())


def _fluidsynth() -> Any:
    """Return the binding of FluidSynth; `UserError` where it or the library that it binds is missing."""
    try:
        import fluidsynth
    except ImportError as error:
        raise UserError(
            f"songs that a band plays need FluidSynth ({error}); pip install 'motionloom[band]' and the "
            f"library (Debian: apt install libfluidsynth3)"
        ) from None
    return fluidsynth


def sound_font() -> Path:
    """The file; `UserError` where there is none."""
    path = Path(os.environ.get("MOTIONLOOM_SOUND_FONT", SOUND_FONT))
    if not path.is_file():
        raise UserError(
            f"{path}: no such sound font, which songs that a band plays need; install one (Debian: "
            f"apt install fluid-soundfont-gm libfluidsynth3) or name it in MOTIONLOOM_SOUND_FONT"
        )
    return path


class Note(NamedTuple):
    """One stroke or note of the score."""

    at: float
    """Seconds."""
    seconds: float
    channel: int
    pitch: int
    loud: int
    """Velocity, 1..127."""


@dataclass(frozen=True)
class LineUp:
    """Players of a song and their manner, drawn once."""

    kit: str
    """full, sparse (beats are left out), hats, kick, hands (claps, shakers) or none."""
    feel: str
    """even, half, double or syncopated."""
    swing: float
    """Delay of the second half of each half beat, as a share of it."""
    programs: dict[int, int]
    with_bass: bool
    with_chords: bool
    with_pad: bool
    with_lead: bool
    arpeggio: bool

    @staticmethod
    def drawn(song: Song, rng: np.random.Generator) -> LineUp:
        """For a genre of sways fewer drums and more pads; to recorded motion all drums, on even beats."""
        calm = song.style.style == "sway"
        danced = song.first is not None
        kits = ("full", "sparse", "hats", "kick", "hands", "none")
        kit = str(
            rng.choice(
                kits, p=(0.2, 0.2, 0.15, 0.05, 0.15, 0.25) if calm else (0.5, 0.2, 0.08, 0.07, 0.08, 0.07)
            )
        )
        feel = str(rng.choice(("even", "half", "double", "syncopated"), p=(0.55, 0.15, 0.1, 0.2)))
        bare = kit in ("none", "hats")
        return LineUp(
            "full" if danced else kit,
            "even" if danced else feel,
            swing=0.0 if danced else float(rng.uniform(0.1, 0.33)) if rng.random() < 0.2 else 0.0,
            programs={part: int(rng.choice(list(choices))) for part, choices in _PROGRAMS.items()},
            with_bass=rng.random() < 0.9 or bare,
            with_chords=rng.random() < 0.9 or bare,
            with_pad=rng.random() < (0.6 if calm else 0.35),
            with_lead=rng.random() < 0.65,
            arpeggio=rng.random() < (0.5 if calm else 0.2),
        )


def score(song: Song) -> list[Note]:
    """All notes of a song, in no order."""
    rng = np.random.default_rng([song.seed, song.number, 241])
    line_up = LineUp.drawn(song, rng)
    bars = int(np.ceil(song.seconds / (song.beat * song.meter))) + 1
    notes: list[Note] = []
    energies = [song.section_of(bar * song.meter) for bar in range(bars + 1)]
    for bar in range(bars):
        section = energies[bar]
        following = energies[bar + 1]
        begins = bar == 0 or energies[bar - 1] is not section
        if section.energy == 0.0:
            notes += _break(song, bar, line_up, begins)
            continue
        notes += _drums(song, bar, section, line_up, begins, following is not section, rng)
        notes += _harmony(song, bar, section, line_up, rng)
    return notes


def play_band(song: Song, rate: int) -> NDArray[np.float32]:
    """The song as dry mono samples [seconds * rate], loudest 1; `UserError` where there is no band."""
    rng = np.random.default_rng([song.seed, song.number, 251])
    programs = instruments(song, rng)
    notes = [note._replace(at=note.at + _SOFT_HANDS * rng.standard_normal()) for note in score(song)]
    sound = perform(notes, programs, song.seconds, rate)
    return np.asarray(sound / max(1.0, float(np.abs(sound).max())), dtype=np.float32)


def instruments(song: Song, rng: np.random.Generator) -> dict[int, int]:
    """Programs of a song's band by channel; that of the drums is drawn by `rng`."""
    line_up = LineUp.drawn(song, np.random.default_rng([song.seed, song.number, 241]))
    return line_up.programs | {DRUMS: int(rng.choice([0, 8, 16, 24, 25, 32, 40]))}


def _loaded(font: Path, rate: int) -> tuple[Any, int]:
    """A synthesiser without effects, and the number of its sound font."""
    dry = {"synth.reverb.active": 0, "synth.chorus.active": 0}
    synth = _fluidsynth().Synth(gain=0.5, samplerate=rate, channels=16, **dry)
    return synth, synth.sfload(str(font))


@lru_cache(maxsize=1)
def _kept(font: Path) -> object:
    """Holds a sound font in memory: FluidSynth reads 140 MB anew where nobody has it."""
    return _loaded(font, 44_100)


def perform(
    notes: Iterable[Note], programs: Mapping[int, int], seconds: float, rate: int
) -> NDArray[np.float32]:
    """Notes played by instruments, by channel, as dry mono samples [seconds * rate]; 1 is usual, not most."""
    font = sound_font()
    _kept(font)
    synth, number = _loaded(font, rate)
    for channel, program in programs.items():
        synth.program_select(channel, number, _DRUM_BANK if channel == DRUMS else 0, program)
    strokes: list[tuple[int, bool, Note]] = []
    for note in notes:
        at = max(0.0, note.at)
        strokes.append((round(at * rate), True, note))
        strokes.append((round((at + note.seconds) * rate), False, note))
    total = round(seconds * rate)
    blocks = []
    now = 0
    # Of what is at one time, notes end before others begin.
    for at, begins, note in sorted(strokes, key=lambda stroke: stroke[:2]):
        if at >= total:
            break
        if at > now:
            blocks.append(synth.get_samples(at - now))
            now = at
        if begins:
            synth.noteon(note.channel, note.pitch, note.loud)
        else:
            synth.noteoff(note.channel, note.pitch)
    if now < total:
        blocks.append(synth.get_samples(total - now))
    synth.delete()
    return np.asarray(np.concatenate(blocks).reshape(-1, 2).mean(axis=1), dtype=np.float32)


# ---- who plays what


def _drums(
    song: Song, bar: int, section: Section, how: LineUp, begins: bool, ends: bool, rng: np.random.Generator
) -> Iterator[Note]:
    """The drums of one bar; what is quiet leaves the kick and the snare out."""
    if how.kit == "none":
        return
    genre = song.style
    steps = 4 * song.meter
    half = how.feel == "half"
    double = how.feel == "double"
    middle = steps // 2 if song.meter == 4 else 4
    backbeat = (
        {middle} if half else set(range(2, steps, 4)) if double else {4, 12} if song.meter == 4 else {4, 8}
    )
    kicks = {step for step in range(steps) if genre.kick[step % 16] != "."} if song.meter == 4 else {0}
    if how.feel == "syncopated":
        kicks = {0} | {int(step) for step in rng.choice(np.arange(1, steps), size=2, replace=False)}
    quiet = section.energy < 0.45
    loud = 0.45 + 0.55 * section.energy
    if begins and section.energy > 0.6 and how.kit in ("full", "sparse"):
        yield _stroke(song, bar, 0, how, CRASH, 100 * loud)
    fill = ends and how.kit == "full" and rng.random() < 0.6
    every = 4 if section.energy < 0.35 else 2 if section.energy < 0.8 else int(rng.choice([1, 2]))
    time_keeper = RIDE if section.kind else HAT
    for step in range(steps):
        if fill and step >= steps - 4:
            yield _stroke(song, bar, step, how, _TOMS[step % 4] if rng.random() < 0.7 else SNARE, 95 * loud)
            continue
        if how.kit == "sparse" and rng.random() < 0.3:
            continue
        accent = 1.0 if step % 4 == 0 else 0.75
        if how.kit in ("full", "sparse", "hats") and step % every == 0:
            yield _stroke(song, bar, step, how, time_keeper, 75 * loud * accent * rng.uniform(0.8, 1.1))
        if how.kit == "hands":
            if step % 2 == 0:
                yield _stroke(song, bar, step, how, SHAKER, 80 * loud * accent)
            if step in backbeat:
                yield _stroke(song, bar, step, how, _CLAP, 95 * loud)
        if quiet or how.kit in ("hats", "hands"):
            continue
        if step in kicks:
            yield _stroke(song, bar, step, how, KICK, 105 * loud)
        if step in backbeat and how.kit != "kick":
            yield _stroke(song, bar, step, how, SNARE if section.energy > 0.5 else _RIM, 100 * loud)


def _harmony(song: Song, bar: int, section: Section, how: LineUp, rng: np.random.Generator) -> Iterator[Note]:
    """Bass, chords, pad and melody of one bar."""
    genre = song.style
    steps = 4 * song.meter
    degree = genre.progressions[section.kind][bar % 4]
    loud = 0.5 + 0.5 * section.energy
    root = 33 + song.key + genre.semitones(degree)  # A1 is 33
    chord = _chord(song, degree)
    if how.with_bass and section.energy > 0.25:
        for place, (step, until) in enumerate(_spans(genre.bass, steps)):
            pitch = root + (12 if genre.name == "disco" and place % 2 else 0)
            yield _note(song, bar, step, until, how, _BASS, pitch, 95 * loud)
    if how.with_chords:
        if how.arpeggio:
            for step in range(0, steps, 2):
                yield _note(song, bar, step, step + 2, how, _CHORDS, chord[step // 2 % 3], 80 * loud)
        else:
            for step, until in _spans(genre.chord, steps):
                for pitch in chord:
                    yield _note(song, bar, step, until, how, _CHORDS, pitch, 78 * loud)
    if how.with_pad or not (how.with_chords or how.with_bass):
        for pitch in chord:
            yield _note(song, bar, 0, steps, how, _PAD, pitch, 70 * loud)
    if how.with_lead and (section.kind or section.energy > 0.5):
        step = int(rng.integers(3))
        while step < steps:
            length = int(rng.choice([1, 2, 2, 3, 4, 6]))
            pitch = 69 + song.key % 12 + genre.semitones(degree + int(rng.choice([0, 1, 2, 4, 5])))
            if rng.random() < 0.8:
                until = min(steps, step + length)
                yield _note(song, bar, step, until, how, _LEAD, pitch, 85 * loud * rng.uniform(0.8, 1.1))
            step += length


def _chord(song: Song, degree: int) -> list[int]:
    """Pitches of a chord around A3, which is 57."""
    base = 57 + song.key - (12 if song.key > 6 else 0)
    return [base + song.style.semitones(degree + third) for third in (0, 2, 4)]


def _spans(pattern: str, steps: int) -> list[tuple[int, int]]:
    """Sixteenths from each hit of a bar's pattern to the next; the whole bar where it has none."""
    hits = [step for step in range(steps) if pattern[step % 16] != "."] or [0]
    return list(pairwise([*hits, steps]))


def _break(song: Song, bar: int, how: LineUp, begins: bool) -> Iterator[Note]:
    """One chord on the first beat of a break, which rings; nothing after it."""
    if not begins:
        return
    genre = song.style
    if how.kit in ("full", "sparse"):
        yield _stroke(song, bar, 0, how, CRASH, 80)
    for pitch in _chord(song, genre.progressions[0][0]):
        yield _note(song, bar, 0, 4 * song.meter, how, _PAD if how.with_pad else _CHORDS, pitch, 70)


def _when(song: Song, bar: int, step: float, how: LineUp) -> float:
    """Seconds of a sixteenth of a bar, swung."""
    late = how.swing if step % 4 == 2 or (how.feel == "double" and step % 2 == 1) else 0.0
    return float(song.times(bar * song.meter + (step + 2 * late) / 4))


def _stroke(song: Song, bar: int, step: int, how: LineUp, drum: int, loud: float) -> Note:
    return Note(_when(song, bar, step, how), 0.1, DRUMS, drum, int(np.clip(loud, 1, 127)))


def _note(
    song: Song, bar: int, step: int, until: int, how: LineUp, part: int, pitch: int, loud: float
) -> Note:
    at = _when(song, bar, step, how)
    seconds = max(0.05, 0.92 * (_when(song, bar, until, how) - at))
    return Note(at, seconds, part, int(np.clip(pitch, 21, 108)), int(np.clip(loud, 1, 127)))
