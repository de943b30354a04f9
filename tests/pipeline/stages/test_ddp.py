"""Two processes on one machine: they finish, leave, agree with one process, and fail together."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from kill_matrix import Cell, Seen, copy_without, run_cells
from preempted import write_recipe
from rich.console import Console
from safetensors.numpy import load_file

from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.training.checkpointing import readable

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
    assert "process 1: rank 0 (process " in output


# Stages whose work all processes share: the same files, bit for bit, by one process and by two.

FIGURES = {"evaluate": "metrics.json"}
CAPTIONS = """
extends: small
name: small
stages:
  evaluate: {clips: 7, repeats: 3, size: 4}
"""
DANCES = """
extends: ude-small
name: ude-small
stages:
  evaluate: {kind: evaluate, clips: 5, repeats: 2, size: 4}
  evaluate_dances: {kind: evaluate_dances, clips: 3, repeats: 2, decodings: 2, shuffles: 1, pool: 4}
"""


def run(start: Callable[..., Any], *arguments: object) -> str:
    process = start(*arguments)
    output: str = process.communicate(timeout=240)[0]
    assert process.returncode == 0, output
    return output


@pytest.mark.parametrize(
    ("given", "recipe", "makers", "stages"),
    [
        ("small_run", CAPTIONS, ["gpt", "face_gpt"], {"tokens": "tokens-train.safetensors", **FIGURES}),
        ("ude_run", DANCES, ["ude"], {**FIGURES, "evaluate_dances": "metrics.json"}),
    ],
)
def test_two_processes_make_what_one_makes(
    given: str, recipe: str, makers: list[str], stages: dict[str, str], start: Callable[..., Any],
    tmp_path: Path, request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    small: Any = request.getfixturevalue(given)
    shutil.copy(small.recipe, tmp_path / small.recipe.name)
    (tmp_path / "shared.yaml").write_text(recipe)
    made: list[dict[str, bytes]] = []
    for devices in (1, 2):
        folder = tmp_path / f"run{devices}"
        shutil.copytree(small.folder, folder)
        for stage in stages:
            run(
                start, "run", tmp_path / "shared.yaml", "--out", folder, "--from", stage, "--until", stage,
                "--set", f"hardware.devices={devices}",
            )  # fmt: skip
        assert not list(folder.glob("stages/*/work"))
        made.append({name: (folder / "stages" / name / file).read_bytes() for name, file in stages.items()})
    assert made[0] == made[1]
    for folder in (tmp_path / "run1", tmp_path / "run2"):
        # Again, by one process and by two, with the settings of the run's own recipe.
        again = run(start, "evaluate", folder)
        assert (folder / "evaluate/metrics.json").read_bytes() == made[0]["evaluate"]
        if "evaluate_dances" in stages:
            dances = folder / "evaluate/evaluate_dances/metrics.json"
            assert dances.read_bytes() == made[0]["evaluate_dances"]
        else:
            assert "reconstruction.mpjpe, mm" in again
            figures = json.loads(made[0]["evaluate"])["figures"]
            assert {"tma.t2m_r1", "tma.matching_score"} <= {one["name"] for one in figures}
    # And what the export makes in the place of the run.
    run(start, "export", folder, "-o", tmp_path / "model")
    generators = [str(tmp_path / "model" / name) for name in makers]
    for stage in (name for name in stages if name.startswith("evaluate")):
        where = f"{stage}.inputs.generators={json.dumps(generators)}"
        run(
            start, "run", tmp_path / "shared.yaml", "--out", folder, "--from", stage, "--until", stage,
            "--set", where,
        )  # fmt: skip
        found = json.loads((folder / "stages" / stage / stages[stage]).read_text())
        before = json.loads(made[0][stage])
        assert before["about"]["made_by"] != found["about"]["made_by"]
        assert all(before[key] == found[key] for key in ("figures", "protocol"))


# Two ranks of one training: killed together they go on bit for bit.

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


@pytest.mark.timeout(400)
def test_two_ranks_killed_in_a_write_and_elsewhere_train_the_same(tried: Tried) -> None:
    """Samples and losses of every step of both ranks, and the files of the stage."""
    seen = tried.seen
    assert (seen.kills, seen.steps) == (3, STEPS) and seen.in_a_write > 0
    assert seen.exact, seen


@pytest.mark.timeout(400)
def test_a_damaged_shard_ends_both_ranks_with_one_sentence(tried: Tried, tmp_path: Path) -> None:
    run = tmp_path / "run"
    copy_without(tried.base, run, "tokenizer")
    shard = next((run / "stages/data/shards").glob("*-val-*.tar"))
    raw = bytearray(shard.read_bytes())
    raw[len(raw) // 2] ^= 4
    shard.write_bytes(raw)
    words = ["run", tried.recipe, "--out", run, "--until", "tokenizer", "--set", "hardware.devices=2"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "motionloom", *map(str, words)],
        capture_output=True, text=True, timeout=240, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    said = [line for line in done.stderr.splitlines() if "error" in line or "rank" in line]
    assert len(said) == 1 and said[0].startswith(f"error: {shard}: the sha256 ")
    assert not (run / "stages/tokenizer/checkpoints").exists()


# A run that was killed ends with the same bytes as one that was not.


Moment = Callable[[Path], bool]

# When each of the killed runs dies: in a stage, as soon as its folder looks like this.
MOMENTS: dict[str, Moment] = {
    "data": lambda folder: any((folder / "shards").glob("*")),
    "tokenizer": lambda folder: (folder / "checkpoints/step=00000006.ckpt").is_file(),
    "tokens": lambda folder: (folder / "started.json").is_file(),
    "gpt": lambda folder: (folder / "checkpoints/step=00000012.ckpt").is_file(),
}


def kill(process: Any) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def artifacts(run: Path) -> dict[str, str]:
    return {path.parent.name: path.read_text() for path in run.glob("stages/*/artifact.json")}


def test_a_run_killed_four_times_equals_the_undisturbed_one(
    small_run: Any, start: Callable[..., Any], tmp_path: Path
) -> None:
    run = tmp_path / small_run.folder.name
    for stage, moment in MOMENTS.items():
        folder = run / "stages" / stage
        process = start("run", small_run.recipe, "--out", run)
        end = time.monotonic() + 120
        while not moment(folder):
            assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
            time.sleep(0.001)
        kill(process)
        assert not (folder / "artifact.json").exists(), f"{stage} was over before the kill"
    newest = next(readable(run / "stages/gpt/checkpoints"))[0]
    assert newest is not None
    newest.write_bytes(newest.read_bytes()[: newest.stat().st_size // 2])
    process = start("run", small_run.recipe, "--out", run)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "resuming gpt at step " in output
    assert "tokenizer (" not in output
    assert artifacts(run) == artifacts(small_run.folder)
    assert len(list(run.glob("stages/tokenizer/checkpoints/*"))) == 2
    assert not list(run.rglob("*.tmp")) and not list(run.glob("stages/.*"))


@pytest.mark.parametrize("stage", ["tokenizer", "gpt"])
def test_killed_between_the_last_step_and_the_artifact(
    stage: str, small_run: Any, tmp_path: Path, call: Callable[..., Any]
) -> None:
    run = tmp_path / small_run.folder.name
    shutil.copytree(small_run.folder, run)
    for name in ("artifact.json", "model.json", "model.safetensors"):
        (run / "stages" / stage / name).unlink()
    done = call("run", small_run.recipe, "--out", run)
    assert done.code == 0 and "1 of 15 " in done.out
    assert artifacts(run) == artifacts(small_run.folder)
