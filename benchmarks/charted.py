"""Songs whose beats are charted by hand: games of rhythm, and MIDI files that a synthesiser plays.

A place is a file or a folder of them, read by its kind:

- Frets on Fire: `notes.mid` beside `song.ogg` (Debian: fretsonfire-songs-muldjord and -sectoid);
- StepMania: `*.sm` or `*.ssc` and the sound that it names (github.com/stepmania/stepmania, `Songs/`);
- Friday Night Funkin': `charts/WEEK/SONG.lua` and `music/WEEK/SONG-inst.ogg`
  (github.com/HTV04/funkin-rewritten, `src/love`);
- `*.mid`, of which the file counts the beats, played with the sound font that MOTIONLOOM_SOUND_FONT names
  (Debian: openttd-openmsx, timgm6mb-soundfont);
- any other sound with a file beside it, `song.beats`, a line of seconds each.

Charts are late or early by the padding of codecs: each is moved by what brings it onto the most of the
music's spectral flux, within 90 ms, without any tracker. Some are not on the beat, and left out (`SLIPPING`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.beat_net import ROWS, band_power
from motionloom.datasets.audio.sound import Sound, read_sound
from motionloom.pipeline.songs.band import Note, perform
from motionloom.pipeline.songs.scores import Score, read_score

Times = NDArray[np.float64]
SLIPPING = {
    "Feelings": "the chart is half a beat off until second 36",
    "Metal madness": "half a beat off but for seconds 20 to 30",
    "War of freedom": "half a beat off until second 30",
    "bopeebo": "another version's chart: no peak of flux near it",
    "city_blues": "a song of this name is kept for judging",
}
START, SECONDS = 10.0, 60.0
"""Of each song."""
ALIGN = 0.09
RATE = 44_100


def charted(place: Path) -> Iterator[tuple[str, Sound, Times]]:
    """Name, sound and beats of each song of a place, a minute of it; beats count from the sound's start."""
    files = [place] if place.is_file() else sorted(place.rglob("*"))
    for file in files:
        found = song_of(file)
        if found is None or any(name in str(file) for name in SLIPPING):
            continue
        sound, beats = found
        if file.suffix != ".mid" or file.name == "notes.mid":
            beats = beats + lateness(sound, beats)
        start = START if sound.seconds > START + SECONDS / 2 else 0.0
        part = sound.slice(start, min(sound.seconds, start + SECONDS))
        inside = beats[(beats >= start) & (beats < start + part.seconds)] - start
        name = file.parent.name if file.name == "notes.mid" else file.stem
        yield name, replace(part, piece=None, begin=0.0), inside


def song_of(file: Path) -> tuple[Sound, Times] | None:
    """Sound and charted beats of one file; None for files of no known kind."""
    text = file.read_text("utf-8", "replace") if file.suffix in (".sm", ".ssc", ".lua") else ""
    if file.name == "notes.mid":
        parts = [read_sound(path)[0] for path in sorted(file.parent.glob("*.ogg"))]
        rate = read_sound(file.parent / "song.ogg")[1]
        score = read_score(file.read_bytes(), str(file))
        return mixed(parts, rate), score.beats
    if file.suffix == ".mid":
        score = read_score(file.read_bytes(), str(file))
        return (played(score), score.beats) if score.counted else None
    if file.suffix in (".sm", ".ssc"):
        if file.suffix == ".ssc" and file.with_suffix(".sm").exists():
            return None
        tags = dict(re.findall(r"#(MUSIC|OFFSET|BPMS):([^;]*)", text)[:3])
        sound = file.parent / tags.get("MUSIC", "").strip()
        changes = [part.split("=") for part in tags["BPMS"].split(",")]
        if not sound.is_file() or sound.stat().st_size < 4096 or len(changes) != 1:
            return None
        return Sound.read(sound), grid(float(changes[0][1]), -float(tags["OFFSET"]))
    if file.suffix == ".lua" and not file.stem.endswith(("-easy", "-hard")):
        sound = file.parents[2] / "music" / file.parent.name / f"{file.stem}-inst.ogg"
        sound = sound if sound.is_file() else sound.with_name(f"{file.stem}.ogg")
        tempi = {float(value) for value in re.findall(r"bpm = ([\d.]+)", text)}
        if not sound.is_file() or len(tempi) != 1:
            return None
        return Sound.read(sound), grid(tempi.pop(), 0.0)
    beats = file.with_suffix(".beats")
    return (Sound.read(file), np.loadtxt(beats, ndmin=1)) if file != beats and beats.is_file() else None


def grid(bpm: float, first: float) -> Times:
    return np.asarray(first + np.arange(4000) * 60.0 / bpm)


def mixed(parts: list[NDArray[np.float32]], rate: int) -> Sound:
    """All parts together, the loudest sample at most 1."""
    total = np.zeros(max(map(len, parts)), dtype=np.float32)
    for part in parts:
        total[: len(part)] += part
    return Sound(total / max(1.0, float(np.abs(total).max())), rate)


def played(score: Score) -> Sound:
    """A MIDI file through the synthesiser, as it is written."""
    programs = dict.fromkeys(range(16), 0)
    for _, channel, program in reversed(score.programs):
        programs[channel] = program
    notes: list[Note] = list(score.notes)
    samples = perform(notes, programs, min(START + SECONDS, float(score.beats[-1])), RATE)
    return mixed([samples], RATE)


def lateness(sound: Sound, beats: Times) -> float:
    """Seconds by which the chart is early, of the shift within 90 ms that meets most spectral flux."""
    power = band_power(sound)
    rise = np.maximum(np.diff(np.log10(power + 1e-6), axis=0, prepend=0.0), 0.0).mean(axis=1)
    at = np.arange(len(rise)) / ROWS
    shifts = np.arange(-ALIGN, ALIGN + 1e-9, 0.002)
    inside = beats[(beats > 0.2) & (beats < sound.seconds - 0.2)]
    return float(shifts[np.argmax([np.interp(inside + shift, at, rise).mean() for shift in shifts])])
