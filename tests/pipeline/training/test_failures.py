"""Trainings that go wrong leave the batch and the traceback."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file
from toy_training import ToyBatches, ToyConfig, toy_recipe

from motionloom.models.training.stage_module import StepFigures
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.training.failures import Failure, NotFiniteError, first_failure

FAILS = 13
"""Number of the batch: of step 14, between the checkpoints of steps 10 and 15."""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        yield toy_recipe(tmp_path_factory.mktemp("crash"), patch)


def test_a_loss_that_is_not_finite_stops_the_training(recipe: Path) -> None:
    run = recipe.parent / "lost"
    with pytest.raises(NotFiniteError) as error:
        run_recipe(recipe, run, overrides=[f"toy.fails_at={FAILS}"], console=Console(quiet=True))
    stage = run / "stages/toy"
    folder = stage / "crash/step_00000014"
    for part in ("toy", "step 14", "recon = nan, loss = nan", str(folder)):
        assert part in str(error.value)
    assert "recon = nan" in (folder / "error.txt").read_text()
    batch, whole = load_file(folder / "batch.safetensors"), ToyBatches(ToyConfig(fails_at=FAILS), 4, 8, 0, 1)
    assert batch.keys() == whole[FAILS].keys()
    assert torch.equal(batch["motion"].nan_to_num(7), whole[FAILS]["motion"].nan_to_num(7))
    kept = sorted(path.name for path in (stage / "checkpoints").glob("*.ckpt"))
    assert kept == ["step=00000005.ckpt", "step=00000010.ckpt"], "no checkpoint of a lost network"


def test_an_error_in_a_step_leaves_its_traceback(call: Callable[..., Any], recipe: Path) -> None:
    run = recipe.parent / "error"
    done = call("run", recipe, "-o", run, "--set", "toy.fails_at=2", "--set", "toy.failure=error")
    folder = run / "stages/toy/crash/step_00000003"
    assert done.code == 1 and "ArithmeticError" in done.err and str(folder) in done.out
    assert "in losses" in (folder / "error.txt").read_text() and (folder / "batch.safetensors").is_file()


def figures(step: int, **values: float) -> StepFigures:
    return StepFigures(step, tuple(values), torch.tensor(list(values.values())))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("steps", "norms", "scaled", "expected"),
    [
        ([figures(1, loss=1.0), figures(2, loss=2.0)], [(1, 1.0)], False, None),
        ([figures(1, accuracy=NAN, loss=1.0)], [], False, None),  # a metric may lack a value
        ([figures(3, ce=NAN, loss=NAN), figures(4, loss=NAN)], [(2, 1.0), (3, NAN)], False, 3),
        ([figures(3, critic_loss=INF, loss=1.0)], [], False, 3),
        ([figures(3, loss=1.0), figures(4, loss=NAN)], [(3, INF), (4, NAN)], False, 3),
        ([figures(3, loss=1.0)], [(3, INF)], True, None),  # the scaler skips that step
    ],
)
def test_the_first_failure(steps: Any, norms: Any, scaled: bool, expected: int | None) -> None:
    module: Any = SimpleNamespace(figures=steps, norms=[(step, torch.tensor(norm)) for step, norm in norms])
    found = first_failure(module, scaled=scaled)
    assert (found and found.step) == expected
    assert module.figures == module.norms == []


def test_the_rank_whose_own_loss_failed_comes_first() -> None:
    assert Failure(3, {"loss": NAN}).order < Failure(3).order < Failure(4, {"loss": NAN}).order
