"""CPU seconds of commands that compute next to nothing: what a person waits for before anything happens.

    python benchmarks/startup.py [--program motionloom] [--runs 3] [--work FOLDER]

Each command runs alone, `--runs` times, with one thread; the least user plus system time counts, of the
process and all it started. Wall time would measure what else the machine does. `--program` is any installed
version (several words: `--program "python -P -m motionloom.pipeline.cli.main"`); it first makes a small data
set, a BVH file and a finished run of its own in `--work`, by default a temporary folder.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

RECIPE = """
name: startup
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {kind: synth, clips: 12}
  stats: {kind: stats}
  tokenizer:
    kind: h2vq
    net: {width: 32, num_codes: 16}
    train: {steps: 2, batch_size: 4, validate_every: 0}
"""

NEW_RECIPE = "humantomato-tiny"
"""Shipped; nothing of it has run."""

BVH_TO_NPZ = """
from pathlib import Path
import sys, numpy
from motionloom.datasets.motion.bvh.motion import read_bvh
numpy.savez(sys.argv[2], joints=read_bvh(Path(sys.argv[1])).positions())
"""

TO_BVH = """
from pathlib import Path
import sys, numpy
from motionloom.datasets.motion.bvh.motion import write_bvh
from motionloom.datasets.motion.skeleton import Skeleton
body = Skeleton.named("smpl22")
turns = numpy.tile(numpy.eye(3), (60, len(body), 1, 1))
write_bvh(Path(sys.argv[1]), body, turns, numpy.zeros((60, 3)), 30.0)
"""


def commands(program: list[str], work: Path) -> dict[str, list[str]]:
    """What is measured, by the name it has in the table."""
    run = ["run", str(work / "startup.yaml"), "--out", str(work / "run")]
    named = {
        "--help": ["--help"],
        "generate --help": ["generate", "--help"],
        "data convert --help": ["data", "convert", "--help"],
        "data convert bvh --help": ["data", "convert", "bvh", "--help"],
        "info": ["info"],
        "data check (12 clips)": ["data", "check", str(work / "shards")],
        "data stats (12 clips)": ["data", "stats", str(work / "shards")],
        "run, nothing to do": run,
        "run --dry-run, finished": [*run, "--dry-run"],
        "run --dry-run, new recipe": ["run", NEW_RECIPE, "--out", str(work / "none"), "--dry-run"],
        "evaluate --tables": ["evaluate", "--tables"],
    }
    return {name: [*program, *words] for name, words in named.items()}


def cpu_seconds(command: Sequence[str]) -> float:
    """User and system time of a command and of all that it waited for."""
    quiet = [(os.POSIX_SPAWN_OPEN, handle, os.devnull, os.O_WRONLY, 0) for handle in (1, 2)]
    child = os.posix_spawnp(command[0], command, {**os.environ, "OMP_NUM_THREADS": "1"}, file_actions=quiet)
    _, status, used = os.wait4(child, 0)
    if status:
        raise SystemExit(f"failed: {shlex.join(command)}")
    return used.ru_utime + used.ru_stime


def prepare(program: list[str], python: list[str], work: Path) -> None:
    """The data set, the BVH file and the finished run."""
    (work / "startup.yaml").write_text(RECIPE)
    for words in (
        [*program, "data", "synth", str(work / "shards"), "--clips", "12", "--workers", "1"],
        [*program, "run", str(work / "startup.yaml"), "--out", str(work / "run")],
        [*python, "-c", TO_BVH, str(work / "clip.bvh")],
    ):
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--program", default="motionloom")
    parser.add_argument("--python", default=f"{sys.executable} -P", help="for what has no command")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    program, python = shlex.split(options.program), shlex.split(options.python)
    with tempfile.TemporaryDirectory() as temporary:
        work = (options.work or Path(temporary)).absolute()
        work.mkdir(parents=True, exist_ok=True)
        prepare(program, python, work)
        todo = commands(program, work)
        todo["one BVH file to npz, in Python"] = [
            *python, "-c", BVH_TO_NPZ, str(work / "clip.bvh"), str(work / "clip.npz"),
        ]  # fmt: skip
        print("| command | CPU seconds |\n| --- | --- |")
        for name, command in todo.items():
            least = min(cpu_seconds(command) for _ in range(options.runs))
            print(f"| {name} | {least:.2f} |", flush=True)


if __name__ == "__main__":
    main()
