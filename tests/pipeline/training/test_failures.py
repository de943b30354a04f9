"""Trainings that go wrong end before a checkpoint of a lost network, or of other data, is written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from rich.console import Console
from toy_training import ToyBatches, toy_recipe

from motionloom.datasets.schema import ShardInfo, UserError
from motionloom.datasets.shards.checksums import LocalShard
from motionloom.models.training.stage_module import StepFigures
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.continuation import newest_step
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.training_log import rise_of_loss
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
    for part in ("toy", "step 14", "recon = nan, loss = nan"):
        assert part in str(error.value)
    kept = sorted(path.name for path in (stage / "checkpoints").glob("*.ckpt"))
    assert kept == ["step=00000005.ckpt", "step=00000010.ckpt"], "no checkpoint of a lost network"


def test_a_shard_that_changes_ends_the_training_before_its_next_checkpoint(
    recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named, also where reading it has failed."""
    shards = [recipe.parent / name for name in ("one.tar", "two.tar")]
    info = ShardInfo(name="a.tar", split="train", samples=1, frames=1, bytes=1, sha256="0" * 64)
    monkeypatch.setattr(Data, "local_shards", lambda _: [LocalShard(path, info) for path in shards])
    kind = SimpleNamespace(gives=lambda _: {"data"})
    data = CompletedStage("data", cast(Any, kind), None, recipe.parent, {})
    monkeypatch.setattr("motionloom.pipeline.runs.execute.stage_inputs", lambda *_: {"data": data})
    read = ToyBatches.__getitem__

    def touched(self: ToyBatches, k: int) -> dict[str, torch.Tensor]:
        if k == FAILS:
            shards[1].write_text("longer")
        return read(self, k)

    monkeypatch.setattr(ToyBatches, "__getitem__", touched)
    never = "hardware.verify_shards=never"  # these are none
    for sets in ([never], [never, f"toy.fails_at={FAILS}", "toy.failure=error"]):
        for path in shards:
            path.write_text("a")
        run = recipe.parent / f"touched{len(sets)}"
        with pytest.raises(UserError, match=str(shards[1])):
            run_recipe(recipe, run, overrides=sets, console=Console(quiet=True))
        assert newest_step(run / "stages/toy") == 10


def test_a_loss_that_rises_a_thousand_times_is_said() -> None:
    rows = [{"step": 10.0 * k, "train/loss": loss} for k, loss in enumerate((2.0, 1.0, 2100.0))]
    assert "1,050 times" in str(rise_of_loss([*rows, {"step": 20.0, "val/loss": 1.0}]))
    assert rise_of_loss(rows[:2]) is None and rise_of_loss([]) is None


def figures(step: int, **values: float) -> StepFigures:
    return StepFigures(step, tuple(values), torch.tensor(list(values.values())))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("steps", "norms", "expected"),
    [
        ([figures(1, loss=1.0), figures(2, loss=2.0)], [(1, 1.0)], None),
        ([figures(1, accuracy=NAN, loss=1.0)], [], None),  # a metric may lack a value
        ([figures(3, ce=NAN, loss=NAN), figures(4, loss=NAN)], [(2, 1.0), (3, NAN)], 3),
        ([figures(3, critic_loss=INF, loss=1.0)], [], 3),
        ([figures(3, loss=1.0), figures(4, loss=NAN)], [(3, INF), (4, NAN)], 3),
    ],
)
def test_the_first_failure(steps: Any, norms: Any, expected: int | None) -> None:
    module: Any = SimpleNamespace(figures=steps, norms=[(step, torch.tensor(norm)) for step, norm in norms])
    found = first_failure(module)
    assert (found and found.step) == expected
    assert module.figures == module.norms == []


def test_the_rank_whose_own_loss_failed_comes_first() -> None:
    assert Failure(3, {"loss": NAN}).order < Failure(3).order < Failure(4, {"loss": NAN}).order
