"""Two ranks of one training: killed together they go on bit for bit.

The whole matrix of kills is `benchmarks/reliability.py`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from kill_matrix import Cell, Seen, copy_without, run_cells
from preempted import write_recipe
from rich.console import Console

from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

STEPS = 40


class Tried(NamedTuple):
    """A training on two ranks that was killed, and the folder of one that was not."""

    recipe: Path
    base: Path
    seen: Seen
    calm: Path


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Tried:
    """Three kills: before a step, at a random moment, and while a checkpoint is half written."""
    folder = tmp_path_factory.mktemp("ranks")
    recipe, base = write_recipe(folder, STEPS), folder / "run"
    run_recipe(recipe, base, select=Selection(until="stats"), console=Console(quiet=True))
    often = ("tokenizer.train.checkpoint_every=5",)
    cell = Cell("killed", str(recipe), str(base), "tokenizer", ranks=2, kills=3, settings=often)
    (seen,) = run_cells([cell], folder / "tries", timeout=300)
    return Tried(recipe, base, seen, folder / "tries/calm-tokenizer-2")


def test_two_ranks_killed_in_a_write_and_elsewhere_train_the_same(tried: Tried) -> None:
    """Samples and losses of every step of both ranks, and the files of the stage."""
    seen = tried.seen
    assert (seen.kills, seen.steps) == (3, STEPS) and seen.in_a_write > 0
    assert seen.exact, seen


def test_a_damaged_shard_ends_both_ranks_with_one_sentence(tried: Tried, tmp_path: Path) -> None:
    run = tmp_path / "run"
    copy_without(tried.base, run, "tokenizer")
    shard = next((run / "stages/data/shards").glob("*-val-*.tar"))
    raw = bytearray(shard.read_bytes())
    raw[len(raw) // 2] ^= 4
    shard.write_bytes(raw)
    words = ["run", tried.recipe, "--out", run, "--until", "tokenizer", "--set", "hardware.devices=2"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main", *map(str, words)],
        capture_output=True, text=True, timeout=240, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    said = [line for line in done.stderr.splitlines() if "error" in line or "rank" in line]
    assert len(said) == 1 and said[0].startswith(f"error: {shard}: the sha256 ")
    assert not (run / "stages/tokenizer/checkpoints").exists()
