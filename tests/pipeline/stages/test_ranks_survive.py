"""Two ranks of one training: killed together they go on bit for bit, and two machines train as one does.

The whole matrix of kills, and what it has shown, is in docs/reliability.md.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from kill_matrix import Cell, Seen, copy_without, finished_files, run_cells
from preempted import write_recipe
from rich.console import Console
from step_records import RECORDS, rows_of
from two_networks import two_networks, why_not

from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.graph import Selection

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

STEPS = 40
HELPERS = Path(__file__).resolve().parents[2] / "helpers"


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
    assert (seen.kills, seen.in_a_write, seen.steps) == (3, 1, STEPS)
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
    assert said == [
        f"error: {shard}: the sha256 is not the manifest's: damaged; copy it back or convert again"
    ]
    assert not (run / "stages/tokenizer/checkpoints").exists()


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_two_machines_train_the_same_as_one(tried: Tried, tmp_path: Path) -> None:
    """torchrun on two nodes that share a run folder and a cable, against two ranks on one machine."""
    run, records = tmp_path / "run", tmp_path / "records"
    copy_without(tried.base, run, "tokenizer")
    records.mkdir()
    python = (sys.executable, "-P", "-m")
    program = (
        *python,
        "motionloom.pipeline.cli.main",
        "run",
        tried.recipe,
        "--out",
        run,
        "--until",
        "tokenizer",
    )
    machines = ("--set", "hardware.nodes=2", "--set", "hardware.devices=1")
    often = ("--set", "tokenizer.train.checkpoint_every=5")
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(HELPERS)]))
    watched = {"MOTIONLOOM_STAGES": "watched_steps", RECORDS: str(records), "PYTHONPATH": path}
    with two_networks() as nodes:
        meet = ("--nnodes=2", "--nproc-per-node=1", "--rdzv-backend=c10d", "--rdzv-id=cable")
        meet += (f"--rdzv-endpoint={nodes[0].address}:29400",)
        ends = []
        for node in nodes:
            launcher = (
                *python,
                "torch.distributed.run",
                *meet,
                f"--local-addr={node.address}",
                "--no-python",
            )
            ends.append(
                subprocess.Popen(
                    node.words(*launcher, *program, *machines, *often),
                    env={**os.environ, **watched, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": node.device},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            )
        try:
            said = [end.communicate(timeout=240)[0] for end in ends]
        finally:
            for end in ends:
                end.kill()
    assert [end.returncode for end in ends] == [0, 0], said
    assert sum("2 nodes" in one for one in said) == 1, "only the lead speaks"
    stages = [place / "stages/tokenizer" for place in (run, tried.calm / tried.base.name)]
    assert finished_files(stages[0]) == finished_files(stages[1])
    trained = [
        {(rank, row["step"]): (row["batch"], row["figures"]) for rank, row in rows_of(place)}
        for place in (records, tried.calm / "records")
    ]
    assert len(trained[0]) == 2 * STEPS and trained[0] == trained[1]
