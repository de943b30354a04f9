"""A week of one training: four processes, a look at step 200, another precision, two processes lost, another
learning rate. All of it ends as in one process that nobody has disturbed.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file
from toy_stages import register_toys
from toy_training import RECIPE, ToyTraining

from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.continuation import newest_step
from motionloom.pipeline.runs.snapshot import run_at
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training.checkpointing import name_of, read_checkpoint

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

FOREVER = "toy.train.steps=10000000"
OFTEN = ("toy.train.checkpoint_every=50", "toy.dropout=0", "toy.train.keep_every=200", FOREVER)
HALF = "toy.train.precision=bf16-mixed"
RATE = "toy.optim.lr=0.002"


class Week:
    """A run of the toy by the program, in several processes of this machine."""

    def __init__(self, start: Callable[..., Any], folder: Path) -> None:
        self.start, self.recipe, self.run = start, folder / "toys.yaml", folder / "run"
        self.recipe.write_text(RECIPE)
        self.stage = self.run / "stages/toy"
        self.processes: list[Any] = []

    def begin(self, ranks: int, *sets: str, more: tuple[str, ...] = ()) -> Any:
        """Start the program."""
        words = [word for one in (*OFTEN, f"hardware.devices={ranks}", *sets) for word in ("--set", one)]
        self.processes.append(self.start("run", self.recipe, "-o", self.run, *words, *more))
        return self.processes[-1]

    def until(self, step: int, process: Any) -> None:
        """Wait for a checkpoint of this step or a later one."""
        end = time.monotonic() + 120
        while (newest_step(self.stage) or 0) < step:
            assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
            time.sleep(0.05)

    def stop(self, process: Any) -> int:
        """As a scheduler ends it: saved; returns the step."""
        os.kill(process.pid, signal.SIGTERM)
        output = process.communicate(timeout=60)[0]
        assert process.returncode == 75, output
        step = newest_step(self.stage)
        assert step is not None
        return step


@pytest.fixture
def week(start: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Week]:
    register_toys(monkeypatch, ToyTraining())
    monkeypatch.setenv("MOTIONLOOM_STAGES", "toy_training_stage")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2] / "helpers"))
    one = Week(start, tmp_path)
    yield one
    for process in one.processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def children(process: Any) -> list[int]:
    """The ranks that the first one has started."""
    text = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
    found = [int(word) for word in text.split()]
    return [pid for pid in found if "motionloom" in Path(f"/proc/{pid}/cmdline").read_text()]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds its processes in /proc")
def test_a_week(week: Week, tmp_path: Path) -> None:
    four = week.begin(4)
    week.until(200, four)
    # A look at step 200, while it goes on.
    with run_at(week.run, "200", "toy") as seen:
        looked = load_file(seen / "stages/toy/model.safetensors")
        record = Artifact.find(seen / "stages/toy")
    assert record is not None and record.step == 200
    first = week.stop(four)
    # Another precision. Two of the four processes die, and the other two with them.
    half = week.begin(4, HALF)
    week.until(first + 60, half)
    for rank in children(half)[:2]:
        os.kill(rank, signal.SIGKILL)
    half.communicate(timeout=120)
    assert half.returncode not in (0, 75)
    kept = newest_step(week.stage)
    two = week.begin(2, HALF)
    week.until((kept or 0) + 60, two)
    second = week.stop(two)
    # A lower rate, knowingly; the training that was to go on for ever ends soon.
    steps = f"toy.train.steps={second + 100}"
    refused = week.begin(2, HALF, RATE, steps, more=("--go-on", "tou"))
    assert "'toy'" in refused.communicate(timeout=60)[0] and refused.returncode == 2
    last = week.begin(2, HALF, RATE, steps, more=("--go-on", "toy"))
    output = last.communicate(timeout=120)[0]
    assert last.returncode == 0, output

    # The same in one process, by trainings that end where the others were stopped.
    alone = tmp_path / "alone"
    for sets, go_on in (
        ([f"toy.train.steps={first}"], ()),
        ([HALF, f"toy.train.steps={second}"], ()),
        ([HALF, RATE, steps], ("toy",)),
    ):
        overrides = [*OFTEN, *sets]
        run_recipe(week.recipe, alone, overrides=overrides, go_on=go_on, console=Console(quiet=True))
    stages = [week.stage, alone / "stages/toy"]
    records = [Artifact.find(stage) for stage in stages]
    assert records[0] is not None and records[1] is not None
    told = [(one.step, one.key, one.old, one.new) for one in records[0].changed]
    assert told == [(first, "train.precision", "32-true", "bf16-mixed"), (second, "optim.lr", 0.01, 0.002)]
    assert records[0].changed == records[1].changed and records[0].fingerprint == records[1].fingerprint
    states = [read_checkpoint(stage / "checkpoints" / name_of(200))["state_dict"] for stage in stages]
    for name, value in looked.items():
        assert torch.equal(value, states[0][f"net.{name}"])
        torch.testing.assert_close(value, states[1][f"net.{name}"], rtol=0, atol=1e-5)
    logs = [read_training_log(stage) for stage in stages]
    assert (
        [row["step"] for row in logs[0]] == list(range(10, second + 101, 10)) == [r["step"] for r in logs[1]]
    )
    for mine, theirs in zip(*logs, strict=True):
        exact = mine["step"] <= first  # later steps round to bfloat16, other shares of the batch otherwise
        assert mine["train/loss"] == pytest.approx(theirs["train/loss"], rel=1e-5 if exact else 0.02)
    weights = [load_file(stage / "model.safetensors") for stage in stages]
    for name, value in weights[0].items():
        torch.testing.assert_close(value, weights[1][name], rtol=0, atol=0.005)
