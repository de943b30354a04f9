"""How well beats are found: ours (`datasets/audio/tracker.py`) and librosa's, on rendered and on real songs.

    python benchmarks/beats.py song.ogg other.mp3 --rendered 20 \\
        --reference aubiotrack --reference "python my_tracker.py"

Rendered songs have true beats; none of those here was trained on. A real song has them in a file beside it
(`song.beats`, a line of seconds each), or the beats of two independent trackers are asked for: each
`--reference` is a command that takes the path of a song and prints one beat a line, in seconds. Where two of
them agree within 70 ms for four beats and more, they are right.

F is of beats within 70 ms, each counted once; `any` lets a tracker beat at half or double the tempo; `late`
is the median of how far the found beats are behind the true ones.
"""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
from bench import Column, Record, arguments, command_line, report
from numpy.typing import NDArray

from motionloom.datasets.audio.features import beats as librosa_beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import track
from motionloom.datasets.synth.music.recording import render_song
from motionloom.pipeline.baselines.beats.songs import RENDER_RATE, SongsConfig

Times = NDArray[np.float64]

COLUMNS = (
    Column("ours", "ours", 2),
    Column("ours, any octave", "ours, any octave", 2),
    Column("ours, ms late", "ours, late", 0),
    Column("our downbeats", "our downbeats", 2),
    Column("librosa's", "librosa's", 2),
    Column("librosa's, any octave", "librosa's, any octave", 2),
    Column("librosa's, ms late", "librosa's, late", 0),
)
NEAR = 0.07
RUN = 4
SECONDS = 90.0
"""Seconds of each real song."""
SEED = 99
"""Seed of the rendered songs; the recipe `beats` has another."""


def hits(truth: Times, found: Times) -> int:
    """How many of the true beats are found, no beat counting twice; both ascending."""
    count = at = 0
    for beat in truth:
        while at < len(found) and found[at] < beat - NEAR:
            at += 1
        if at < len(found) and found[at] <= beat + NEAR:
            count, at = count + 1, at + 1
    return count


def f_measure(truth: Times, found: Times) -> float:
    """0..1"""
    return 2 * hits(truth, found) / max(1, len(truth) + len(found))


def tempi(times: Times) -> Iterator[Times]:
    """The same beats at the same, half (twice) and double tempo."""
    yield from (times, times[::2], times[1::2])
    yield np.sort(np.concatenate([times, (times[1:] + times[:-1]) / 2]))


def lateness(truth: Times, found: Times) -> float:
    """Seconds that found beats are behind the true ones, the median of those within 70 ms; NaN of none."""
    away = np.array([found[np.abs(found - beat).argmin()] - beat for beat in truth]) if len(found) else found
    near = away[np.abs(away) <= NEAR]
    return float(np.median(near)) if len(near) else float("nan")


def agreed_runs(one: Times, other: Times) -> list[Times]:
    """Stretches of four beats of `one` and more that `other` has too, with none of its own between them."""
    runs, run = [], list[float]()
    for beat in one:
        near = bool(len(other)) and np.abs(other - beat).min() <= NEAR
        alone = not run or ((other > run[-1] + NEAR) & (other < beat - NEAR)).sum() == 0
        if near and alone:
            run.append(float(beat))
            continue
        runs.append(run)
        run = [float(beat)] if near else []
    return [np.array(run) for run in [*runs, run] if len(run) >= RUN]


def agreed_f(runs: list[Times], found: Times, *, any_tempo: bool) -> float:
    """F within the stretches."""
    pairs = [
        (run, tempo[(tempo > run[0] - NEAR) & (tempo < run[-1] + NEAR)]) for run in runs for tempo in [found]
    ]
    if any_tempo:
        pairs = [max(((t, f) for t in tempi(run)), key=lambda pair: f_measure(*pair)) for run, f in pairs]
    count = sum(hits(*pair) for pair in pairs)
    return 2 * count / max(1, sum(len(truth) + len(found) for truth, found in pairs))


def rendered(count: int) -> Record:
    """F against true beats, averaged over songs."""
    pool = SongsConfig(songs=max(2, count), seed=SEED)
    found: dict[str, list[float]] = {column.figure: [] for column in COLUMNS}
    for number in range(count):
        song = pool.song(number)
        sound = Sound(render_song(song, RENDER_RATE), RENDER_RATE)
        truth = np.array(song.beats_within(0, song.seconds))
        ours, theirs = track(sound), librosa_beats(sound.samples, sound.rate)
        for name, times in (("ours", ours.times), ("librosa's", theirs)):
            found[name].append(f_measure(truth, times))
            found[f"{name}, any octave"].append(max(f_measure(one, times) for one in tempi(truth)))
            found[f"{name}, late"].append(1000 * lateness(truth, times))
        # Bars begin at every beat whose number is a multiple of the meter.
        bars = truth[(song.beat_number(0.0) + np.arange(len(truth))) % song.meter == 0]
        found["our downbeats"].append(f_measure(bars, ours.times[ours.bar_places == 0]))
    cells = {name: [float(np.nanmean(values))] for name, values in found.items() if values}
    return {"title": f"{count} rendered songs", "cells": cells}


def real(path: Path, references: list[str]) -> Record:
    """F against the beats that a file or two trackers agree on."""
    sound = Sound.read(path)
    sound = sound.slice(0, min(SECONDS, sound.seconds))
    ours, theirs = track(sound), librosa_beats(sound.samples, sound.rate)
    runs = _true_runs(path, references, sound.seconds)
    whole, cells = np.concatenate([*runs, np.empty(0)]), dict[str, list[float]]()
    for name, times in (("ours", ours.times), ("librosa's", theirs)) if len(whole) else ():
        cells[name] = [agreed_f(runs, times, any_tempo=False)]
        cells[f"{name}, any octave"] = [agreed_f(runs, times, any_tempo=True)]
        cells[f"{name}, late"] = [1000 * lateness(whole, times)]
    facts = {"confidence": f"{ours.confidence:.2f}", "beats": len(whole)}
    return {"title": path.stem, "cells": cells, "protocol": facts}


def _true_runs(path: Path, references: list[str], seconds: float) -> list[Times]:
    """Stretches of a song whose beats are known."""
    beside = path.with_suffix(".beats")
    if beside.is_file():
        times = np.loadtxt(beside, ndmin=1)
        return [times[times < seconds]]
    known = [_printed(command, path, seconds) for command in references]
    if len(known) < 2:
        raise SystemExit(f"{path}: without {beside.name} it needs two references or more")
    return max((agreed_runs(*two) for two in combinations(known, 2)), key=lambda runs: sum(map(len, runs)))


def _printed(command: str, path: Path, seconds: float) -> Times:
    made = subprocess.run([*shlex.split(command), str(path)], capture_output=True, text=True, check=True)
    times = np.array([float(line.split()[0]) for line in made.stdout.splitlines() if line.strip()])
    return times[times < seconds]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("songs", nargs="*", type=Path)
    parser.add_argument("--rendered", type=int, default=0, help="how many songs to render")
    parser.add_argument("--reference", action="append", default=[], help="a command that prints beats")
    args = arguments(parser)
    rows = [rendered(args.rendered)] if args.rendered else []
    rows += [real(path, args.reference) for path in args.songs]
    report("F of beats within 70 ms", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
