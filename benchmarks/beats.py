"""How well beats are found: ours (`datasets/audio/tracker.py`) and librosa's, on rendered and on real songs.

    python benchmarks/beats.py song.ogg other.mp3 --rendered 20 \\
        --reference aubiotrack --reference "python my_tracker.py"

Rendered songs have true beats; none of those here was trained on. A real song has them in a file beside it
(`song.beats`, a line of seconds each), or the beats of two independent trackers are asked for: each
`--reference` is a command that takes the path of a song and prints one beat a line, in seconds. Where two of
them agree within 70 ms for four beats and more, they are right.

F is of beats within 70 ms, each counted once; `any` lets a tracker beat at half or double the tempo; `late`
is the median of how far the found beats are behind the true ones.
Then what is no music, by `confidence`: silence, noise, and files that `--speech` names.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import beats as librosa_beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import track
from motionloom.datasets.synth.music.performance import render_song
from motionloom.datasets.synth.music.tapped import RENDER_RATE, SongPoolConfig

Times = NDArray[np.float64]

NEAR = 0.07
RUN = 4
SECONDS = 90.0
"""Of each real song."""
SEED = 99
"""Of the rendered songs; the recipe `beats` has another."""


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


def rendered(count: int) -> None:
    """Against true beats."""
    pool = SongPoolConfig(songs=max(2, count), seed=SEED)
    rows, downbeats, late = [], [], []
    for number in range(count):
        song = pool.song(number)
        sound = Sound(render_song(song, RENDER_RATE), RENDER_RATE)
        truth = np.array(song.beats_within(0, song.seconds))
        ours, theirs = track(sound), librosa_beats(sound.samples, sound.rate)
        rows.append(
            [
                max(f_measure(one, found) for one in which(truth))
                for found in (ours.times, theirs)
                for which in (lambda beats: [beats], tempi)
            ]
        )
        late.append([lateness(truth, found) for found in (ours.times, theirs)])
        bars = truth[(song.beat_number(0.0) + np.arange(len(truth))) % song.meter == 0]
        downbeats.append(f_measure(bars, ours.times[ours.bar_places == 0]))
    mean, behind = np.mean(rows, axis=0), 1000 * np.nanmedian(late, axis=0)
    print(
        f"{count} rendered songs, F: ours {mean[0]:.3f} (any {mean[1]:.3f}), librosa {mean[2]:.3f} "
        f"(any {mean[3]:.3f}); our downbeats {np.mean(downbeats):.3f}; late by "
        f"{behind[0]:.0f} and {behind[1]:.0f} ms"
    )


def real(paths: list[Path], references: list[str]) -> None:
    """Against agreed beats."""
    rows = []
    print("| song | confidence | bpm | librosa's | true beats | F (any), late | librosa's |")
    print("|---|---|---|---|---|---|---|")
    for path in paths:
        sound = Sound.read(path)
        sound = sound.slice(0, min(SECONDS, sound.seconds))
        ours, theirs = track(sound), librosa_beats(sound.samples, sound.rate)
        runs = _true_runs(path, references, sound.seconds)
        row = [
            agreed_f(runs, found, any_tempo=which)
            for found in (ours.times, theirs)
            for which in (False, True)
        ]
        beats, whole = sum(map(len, runs)), np.concatenate([*runs, np.empty(0)])
        late = [f"{1000 * lateness(whole, found):.0f} ms" for found in (ours.times, theirs)]
        if beats:
            rows.append(row)
        print(
            f"| {path.stem} | {ours.confidence:.2f} | {_bpm(ours.times):.0f} | {_bpm(theirs):.0f} "
            f"| {beats} | {row[0]:.2f} ({row[1]:.2f}), {late[0]} | {row[2]:.2f} ({row[3]:.2f}), {late[1]} |",
            flush=True,
        )
    mean = np.mean(rows, axis=0)
    print(
        f"{len(rows)} real songs, F: ours {mean[0]:.3f} (any {mean[1]:.3f}), librosa {mean[2]:.3f} "
        f"(any {mean[3]:.3f})"
    )


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


def no_music(speech: list[Path]) -> None:
    """Confidence in what has no beat."""
    rng = np.random.default_rng(0)
    noise = np.clip(0.2 * rng.standard_normal(20 * RENDER_RATE), -1, 1).astype(np.float32)
    sounds = {"silence": Sound(np.zeros_like(noise), RENDER_RATE), "noise": Sound(noise, RENDER_RATE)}
    for name, sound in {**sounds, **{path.stem: Sound.read(path) for path in speech}}.items():
        print(f"{name}: confidence {track(sound).confidence:.2f}")


def _printed(command: str, path: Path, seconds: float) -> Times:
    made = subprocess.run([*shlex.split(command), str(path)], capture_output=True, text=True, check=True)
    times = np.array([float(line.split()[0]) for line in made.stdout.splitlines() if line.strip()])
    return times[times < seconds]


def _bpm(times: Times) -> float:
    return float(60 / np.median(np.diff(times))) if len(times) > 1 else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("songs", nargs="*", type=Path)
    parser.add_argument("--rendered", type=int, default=0, help="how many songs to render")
    parser.add_argument("--reference", action="append", default=[], help="a command that prints beats")
    parser.add_argument("--speech", action="append", default=[], type=Path)
    given = parser.parse_args()
    if given.rendered:
        rendered(given.rendered)
    if given.songs:
        real(given.songs, given.reference)
    no_music(given.speech)


if __name__ == "__main__":
    main()
