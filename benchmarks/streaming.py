"""What streams cost: how soon the first frames come, frames a second, and memory over ten minutes of motion.

    motionloom run humantomato-tiny
    python benchmarks/streaming.py runs/humantomato-tiny --minutes 10

The model is loaded and has answered once (its text encoder loads with the first words). Seconds are those of
the clock and, beside them, of this process's CPU time, which other programs on the machine do not change: on
one thread (the default) it is what a free core takes. Captions change every ten seconds of motion. Memory is
the resident set once the stream is a minute long, at its largest after that, and at its end. Prints a table;
`--json` writes the figures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from motionloom.pipeline.inference.model import MotionModel

CAPTIONS = ("a person walks forward", "a person waves with the left hand", "a person squats")
CAPTION_SECONDS = 10.0
FIRST = 7
"""Streams whose first chunk is timed; the median counts."""


def resident() -> float:
    """This process's resident memory in MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def changing() -> Iterator[tuple[str, float]]:
    """Captions without an end."""
    return ((caption, CAPTION_SECONDS) for caption in itertools.cycle(CAPTIONS))


def first_chunk(model: MotionModel, how: dict[str, str]) -> dict[str, float]:
    """Seconds until the first chunk is there."""
    clock, cpu, frames = [], [], 0
    for seed in range(FIRST):
        began, used = time.perf_counter(), time.process_time()
        frames = len(next(model.stream(CAPTIONS[seed % len(CAPTIONS)], seed=seed, streaming=how)).joints)
        clock.append(time.perf_counter() - began)
        cpu.append(time.process_time() - used)
    return {
        "first_seconds": statistics.median(clock),
        "first_cpu_seconds": statistics.median(cpu),
        "first_frames": frames,
    }


def long_stream(model: MotionModel, how: dict[str, str], minutes: float) -> dict[str, float]:
    """Speed and memory over a long motion."""
    wanted, frames, after_a_minute, largest = minutes * 60 * model.fps, 0, 0.0, 0.0
    began, used = time.perf_counter(), time.process_time()
    for chunk in model.stream(changing(), seed=1, streaming=how):
        frames += len(chunk.joints)
        if frames >= 60 * model.fps:
            now = resident()
            after_a_minute, largest = after_a_minute or now, max(largest, now)
        if frames >= wanted:
            break
    clock, cpu = time.perf_counter() - began, time.process_time() - used
    return {
        "minutes": frames / model.fps / 60,
        "frames_per_second": frames / clock,
        "times_real_time": frames / clock / model.fps,
        "times_real_time_cpu": frames / cpu / model.fps,
        "mib_after_a_minute": after_a_minute,
        "mib_largest": largest,
        "mib_end": resident(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run folders, or exported ones")
    parser.add_argument("--minutes", type=float, default=10.0, help="of motion")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--decoder", choices=("diffusion", "tokenizer"), help="of a UDE")
    parser.add_argument("--json", type=Path, help="write the figures here")
    given = parser.parse_args()
    how = {} if given.decoder is None else {"decoder": given.decoder}
    torch.set_num_threads(given.threads)
    out = {}
    for run in given.runs:
        began = time.perf_counter()
        model = MotionModel.from_pretrained(run, device="cpu")
        next(model.stream(CAPTIONS[0]))
        loaded = {"load_seconds": time.perf_counter() - began}
        figures = first_chunk(model, how) | long_stream(model, how, given.minutes)
        out[run.resolve().name] = loaded | figures
        if given.json is not None:
            given.json.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")
    table = Table("", *out)
    for name in next(iter(out.values())):
        table.add_row(name, *(f"{figures[name]:.3g}" for figures in out.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
