"""How well beats are found: ours (`datasets/audio/tracker.py`) and librosa's, on rendered and on real songs.

    python benchmarks/beats.py song.ogg other.mp3 --rendered 20

Rendered songs have true beats; none of those here was trained on. A real song has them in a file beside it
(`song.beats`, a line of seconds each).

F is of beats within 70 ms, each counted once; `any` lets a tracker beat at half or double the tempo; `late`
is the median of how far the found beats are behind the true ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from bench import Column, Record, arguments, command_line, report
from numpy.typing import NDArray

from motionloom.datasets.audio.features import beats as librosa_beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import track
from motionloom.datasets.synth.music.recording import render_song
from motionloom.datasets.synth.music.song import draw_song

Times = NDArray[np.float64]

COLUMNS = (
    Column("ours", "ours", 2),
    Column("ours, any octave", "ours, any octave", 2),
    Column("ours, ms late", "ours, late", 0),
    Column("librosa's", "librosa's", 2),
    Column("librosa's, any octave", "librosa's, any octave", 2),
    Column("librosa's, ms late", "librosa's, late", 0),
)
NEAR = 0.07
SECONDS = 90.0
"""Seconds of each real song."""
SEED, RENDER_RATE = 99, 32_000
"""Seed of the rendered songs, which the packaged network's training did not have; Hz."""


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


def rendered(count: int) -> Record:
    """F against true beats, averaged over songs."""
    found: dict[str, list[float]] = {column.figure: [] for column in COLUMNS}
    for number in range(count):
        song = draw_song(number, SEED, tempo=(60, 190), seconds=30.0, played=True)
        sound = Sound(render_song(song, RENDER_RATE), RENDER_RATE)
        truth = np.array(song.beats_within(0, song.seconds))
        ours, theirs = track(sound), librosa_beats(sound.samples, sound.rate)
        for name, times in (("ours", ours.times), ("librosa's", theirs)):
            found[name].append(f_measure(truth, times))
            found[f"{name}, any octave"].append(max(f_measure(one, times) for one in tempi(truth)))
            found[f"{name}, late"].append(1000 * lateness(truth, times))
    cells = {name: [float(np.nanmean(values))] for name, values in found.items() if values}
    return {"title": f"{count} rendered songs", "cells": cells}


def real(path: Path) -> Record:
    """F against the beats in the file beside a song, between the first and the last of them."""
    sound = Sound.read(path)
    sound = sound.slice(0, min(SECONDS, sound.seconds))
    truth = np.loadtxt(path.with_suffix(".beats"), ndmin=1)
    truth = truth[truth < sound.seconds]
    ours, cells = track(sound), dict[str, list[float]]()
    for name, times in (("ours", ours.times), ("librosa's", librosa_beats(sound.samples, sound.rate))):
        found = times[(times > truth[0] - NEAR) & (times < truth[-1] + NEAR)]
        cells[name] = [f_measure(truth, found)]
        cells[f"{name}, any octave"] = [max(f_measure(one, found) for one in tempi(truth))]
        cells[f"{name}, late"] = [1000 * lateness(truth, times)]
    facts = {"confidence": f"{ours.confidence:.2f}", "beats": len(truth)}
    return {"title": path.stem, "cells": cells, "protocol": facts}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("songs", nargs="*", type=Path)
    parser.add_argument("--rendered", type=int, default=0, help="how many songs to render")
    args = arguments(parser)
    rows = [rendered(args.rendered)] if args.rendered else []
    rows += [real(path) for path in args.songs]
    report("F of beats within 70 ms", COLUMNS, rows, args.record)


if __name__ == "__main__":
    main()
