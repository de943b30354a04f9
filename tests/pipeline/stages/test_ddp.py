"""Two processes on one machine: they finish, leave, agree with one process, and fail together."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file

from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection

pytestmark = pytest.mark.slow

# Without what draws per process (dropout), so that one and two processes can be compared.
RECIPE = """
extends: small
name: small
stages:
  gpt:
    net: {dropout: 0.0, condition_dropout: 0.0}
    loss: {align_weight: 0.0}
    train: {steps: 10, checkpoint_every: 5, validate_every: 5}
"""
PAIR = ("--set", "hardware.devices=2")


@pytest.fixture(scope="module")
def recipe(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recipes")
    shutil.copy(small_run.recipe, folder / "small.yaml")
    (folder / "pair.yaml").write_text(RECIPE)
    return folder / "pair.yaml"


@pytest.fixture(scope="module")
def single(small_run: Any, recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run by one process; data, statistics and text are there already."""
    run = tmp_path_factory.mktemp("single") / "run"
    shutil.copytree(small_run.folder, run)
    return run_recipe(recipe, run, select=Selection(until="gpt"), replace=True, console=Console(quiet=True))


def finish(process: Any, code: int = 0, seconds: float = 240) -> str:
    """The output of a process that must end by itself."""
    output: str = process.communicate(timeout=seconds)[0]
    assert process.returncode == code, output
    return output


def rows(run: Path, stage: str) -> list[dict[str, float]]:
    return [json.loads(line) for line in (run / "stages" / stage / "metrics.jsonl").read_text().splitlines()]


def files(run: Path) -> set[str]:
    """All but TensorBoard's, which are named after time and process, and what processes note."""
    found = (p for p in run.rglob("*") if p.is_file() and "tfevents" not in p.name)
    found = (p for p in found if p.parent.name != "flight")
    return {p.relative_to(run).as_posix() for p in found}


def assert_same_training(one: Path, two: Path, stage: str) -> None:
    weights = [load_file(run / "stages" / stage / "model.safetensors") for run in (one, two)]
    assert weights[0].keys() == weights[1].keys()
    for name, value in weights[0].items():
        np.testing.assert_allclose(weights[1][name], value, rtol=0, atol=1e-4, err_msg=name)
    logged = [rows(run, stage) for run in (one, two)]
    assert [row["step"] for row in logged[0]] == [row["step"] for row in logged[1]]
    for first, second in zip(*logged, strict=True):
        for name in (name for name in first if name.endswith(("loss", "ce"))):
            assert second[name] == pytest.approx(first[name], rel=1e-3, abs=1e-4), name


def test_torchrun_equals_one_process(
    single: Path, recipe: Path, start: Callable[..., Any], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(single, run)
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    program = Path(sys.executable).with_name("motionloom")
    # The GPT alone, so that both have exactly the same tokens.
    words = ("--no-python", program, "run", recipe, "--out", run, "--from", "gpt", "--until", "gpt")
    output = finish(start(*words, program=torchrun))
    assert output.count("[9/15] gpt") == 1
    assert files(run) == files(single)
    assert_same_training(single, run, "gpt")


def test_a_batch_that_does_not_divide_is_refused_before_anything_runs(
    recipe: Path, call: Callable[..., Any], tmp_path: Path
) -> None:
    done = call("run", recipe, "--out", tmp_path / "run", "--set", "gpt.train.batch_size=7", *PAIR)
    assert done.code == 2 and "train.batch_size 7 " in done.err
    assert not (tmp_path / "run/stages").exists()


def test_an_error_of_the_lead_ends_those_who_wait(
    single: Path, recipe: Path, start: Callable[..., Any], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(single, run)
    (run / "stages/.tokens.removed").write_text("in the way")  # the lead cannot clear the stage's folder
    words = ("run", recipe, "--out", run, "--from", "tokens", "--until", "gpt", *PAIR)
    output = finish(start(*words), code=2)
    assert "where a folder is" in output
    assert "process 1: process 0, which started this one, has ended" in output
