"""A training that goes wrong leaves a bundle, and a replay goes wrong in the same way to the bit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file
from torch import nn
from toy_training import ToyBatches, ToyConfig, toy_recipe

from motionloom.pipeline.flight.not_finite import NotFiniteError
from motionloom.pipeline.flight.replay import ReplaySteps
from motionloom.pipeline.runs import replay as replaying
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.store.checkpoints import read_checkpoint

Call = Callable[..., Any]
FAILS = 13
"""Number of the batch: of step 14, between the checkpoints of steps 10 and 15."""


@dataclass(frozen=True)
class Lost:
    """A run that has failed, and what it said."""

    said: str
    stage: Path
    bundle: Path
    record: dict[str, Any]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        yield toy_recipe(tmp_path_factory.mktemp("crash"), patch)


@pytest.fixture(scope="module")
def lost(recipe: Path) -> Lost:
    """A run with a batch that is not finite."""
    run = recipe.parent / "lost"
    with pytest.raises(NotFiniteError) as error:
        run_recipe(recipe, run, overrides=[f"toy.fails_at={FAILS}"], console=Console(quiet=True))
    bundle = run / f"stages/toy/crash/step_{FAILS + 1:08d}"
    record = json.loads((bundle / "crash.json").read_text())
    return Lost(str(error.value), run / "stages/toy", bundle, record)


def test_one_sentence_names_step_terms_layers_and_the_replay(lost: Lost) -> None:
    assert lost.said == (
        f"stage toy: in step 14 on rank 0 the loss is not finite (recon = nan, loss = nan; gradients of "
        f"encoder, decoder); repeat that step with: motionloom replay {lost.bundle}"
    )


def test_the_record_says_what_happened_and_what_was_read(lost: Lost) -> None:
    record = lost.record
    assert (record["kind"], record["step"], record["rank"], record["world"]) == ("not_finite", 14, 0, 1)
    assert set(record["terms"]) == {"loss", "recon"} and record["groups"] == ["encoder", "decoder"]
    assert record["checkpoint"]["step"] == 10 and record["versions"]["torch"] == torch.__version__
    assert [one["step"] for one in record["steps"]] == list(range(1, 15))
    last = record["steps"][-1]
    assert last["batches"] == [13] and last["samples"][5] == {"clip": "clip13", "first": 5, "length": 3}
    assert math.isnan(last["figures"]["loss"][0]) and math.isfinite(last["figures"]["weight"][0])
    assert all(math.isfinite(one["figures"]["loss"][0]) for one in record["steps"][:-1])


def test_the_batch_is_in_the_bundle(lost: Lost) -> None:
    batch = load_file(lost.bundle / "batch.safetensors")
    whole = ToyBatches(ToyConfig(fails_at=FAILS), 4, 8, 0, 1)[13]
    assert batch.keys() == whole.keys() and torch.equal(batch["motion"].isnan(), whole["motion"].isnan())
    assert torch.equal(batch["motion"].nan_to_num(7), whole["motion"].nan_to_num(7))


def test_no_checkpoint_is_made_of_a_network_that_is_lost(lost: Lost) -> None:
    kept = sorted(path.name for path in (lost.stage / "checkpoints").glob("*.ckpt"))
    assert kept == ["step=00000005.ckpt", "step=00000010.ckpt"]


def test_a_replay_is_the_same_to_the_bit_and_touches_nothing(
    call: Call, lost: Lost, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also once the stage's own checkpoints are gone."""
    for path in (lost.stage / "checkpoints").glob("*.ckpt"):
        path.unlink()
    assert read_checkpoint(lost.bundle / "checkpoint.ckpt")["global_step"] == 10
    before = {path: path.read_bytes() for path in lost.stage.rglob("*") if path.is_file()}
    seen: list[ReplaySteps] = []

    def noted(*given: Any, **more: Any) -> ReplaySteps:
        seen.append(ReplaySteps(*given, **more))
        return seen[-1]

    monkeypatch.setattr(replaying, "ReplaySteps", noted)
    with pytest.warns(UserWarning, match="Error detected in"):
        again = call("replay", lost.bundle, "--anomaly")
    assert again.code == 1, again.err
    assert "repeated steps 11 to 14" in again.out and "its batch is the same as in the bundle" in again.out
    assert "returned nan values" in again.out  # of torch's anomaly mode
    assert "the failure came again, with the same figures to the bit" in again.out
    for one in lost.record["steps"][10:13]:  # those before it are equal too, and finite
        assert seen[0].figures[one["step"]] == one["figures"]
    assert {path: path.read_bytes() for path in lost.stage.rglob("*") if path.is_file()} == before


def test_a_replay_of_other_settings_is_refused(call: Call, lost: Lost) -> None:
    path = lost.stage.parents[1] / "recipe.yaml"
    text = path.read_text()
    path.write_text(text.replace("lr: 0.01", "lr: 0.02"))
    done = call("replay", lost.bundle)
    path.write_text(text)
    assert done.code == 2 and "other settings or inputs now" in done.err
    done = call("replay", lost.bundle.parent)
    assert done.code == 2 and "no crash bundle (no crash.json)" in done.err


def test_an_error_in_a_step_before_the_first_checkpoint(call: Call, recipe: Path) -> None:
    """The bundle has no checkpoint, and the replay begins with the training."""
    run = recipe.parent / "error"
    bundle = run / "stages/toy/crash/step_00000003"
    done = call("run", recipe, "-o", run, "--set", "toy.fails_at=2", "--set", "toy.failure=error")
    assert done.code == 1 and "ArithmeticError: the toy is broken" in done.err
    said = "stage toy: step 3 on rank 0 ended with ArithmeticError: the toy is broken; repeat that step with"
    assert f"{said}: motionloom replay {bundle}" in done.out
    record = json.loads((bundle / "crash.json").read_text())
    assert record["kind"] == "exception" and "in losses" in record["traceback"]
    assert record["checkpoint"] is None and (bundle / "batch.safetensors").is_file()
    again = call("replay", bundle)
    assert again.code == 1 and "repeated steps 1 to 3" in again.out
    assert again.out.strip().endswith("the failure came again")


def test_it_goes_on_where_it_is_asked_to(recipe: Path) -> None:
    run, console = recipe.parent / "on", Console(width=200, record=True, quiet=False)
    sets = [f"toy.fails_at={FAILS}", "toy.train.on_not_finite=continue"]
    run_recipe(recipe, run, overrides=sets, console=console)
    assert console.export_text().count("the loss is not finite") == 1
    assert (run / "stages/toy/crash/step_00000014/crash.json").is_file()
    outputs = json.loads((run / "stages/toy/artifact.json").read_text())["outputs"]
    assert set(outputs) == {"metrics.jsonl", "model.json", "model.safetensors"}


class _Root(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.sqrt()


def test_the_first_layer_that_fails_is_named() -> None:
    net = nn.Module()
    net.net = nn.Sequential(nn.Tanh(), _Root(), nn.Linear(3, 2))  # type: ignore[assignment]
    steps = ReplaySteps(1, 1, anomaly=True)
    steps._hook(net)
    net.net(torch.tensor([[1.0, -1.0, 2.0]]))  # type: ignore[operator]
    assert steps.first_layers == ["net.1 (_Root, group 1)"]
