"""A training that goes wrong leaves a bundle, and a replay goes wrong in the same way to the bit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from toy_training import ToyBatches, ToyConfig, toy_recipe

from motionloom.pipeline.flight.replay import ReplaySteps
from motionloom.pipeline.runs import replay as replaying
from motionloom.pipeline.store.checkpoints import read_checkpoint

Call = Callable[..., Any]
FAILS = 13
"""Number of the batch: step 14, between the checkpoints of steps 10 and 15."""


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return toy_recipe(tmp_path, monkeypatch)


def poisoned(call: Call, recipe: Path, *more: str) -> tuple[Any, Path]:
    """A run with a batch that is not finite, and the bundle it should leave."""
    run = recipe.parent / "run"
    done = call("run", recipe, "-o", run, "--set", f"toy.fails_at={FAILS}", *more)
    return done, run / f"stages/toy/crash/step_{FAILS + 1:08d}"


def test_a_loss_that_is_not_finite_ends_in_one_sentence_and_a_bundle(call: Call, recipe: Path) -> None:
    done, bundle = poisoned(call, recipe)
    assert done.code == 2 and len(done.err.strip().splitlines()) == 1
    assert "stage toy: in step 14 on rank 0 the loss is not finite (recon = nan, loss = nan" in done.err
    assert "gradients of encoder, decoder" in done.err and f"motionloom replay {bundle}" in done.err
    record = json.loads((bundle / "crash.json").read_text())
    assert (record["kind"], record["step"], record["rank"], record["world"]) == ("not_finite", 14, 0, 1)
    assert set(record["terms"]) == {"loss", "recon"} and record["groups"] == ["encoder", "decoder"]
    assert record["checkpoint"]["step"] == 10 and record["versions"]["torch"] == torch.__version__
    assert [one["step"] for one in record["steps"]] == list(range(1, 15))
    last = record["steps"][-1]
    assert last["batches"] == [13] and last["samples"][5] == {"clip": "clip13", "first": 5, "length": 3}
    assert math.isnan(last["figures"]["loss"][0]) and math.isfinite(last["figures"]["weight"][0])
    assert all(math.isfinite(one["figures"]["loss"][0]) for one in record["steps"][:-1])
    batch = load_file(bundle / "batch.safetensors")
    whole = ToyBatches(ToyConfig(fails_at=FAILS), 4, 8, 0, 1)[13]
    assert batch.keys() == whole.keys() and torch.equal(batch["motion"].isnan(), whole["motion"].isnan())
    assert torch.equal(batch["motion"].nan_to_num(7), whole["motion"].nan_to_num(7))


def test_its_checkpoint_outlives_those_of_the_stage(call: Call, recipe: Path) -> None:
    _, bundle = poisoned(call, recipe)
    for path in (bundle.parents[1] / "checkpoints").glob("*.ckpt"):
        path.unlink()
    assert read_checkpoint(bundle / "checkpoint.ckpt")["global_step"] == 10


def test_a_replay_is_the_same_to_the_bit_and_touches_nothing(
    call: Call, recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, bundle = poisoned(call, recipe)
    before = {path: path.read_bytes() for path in (recipe.parent / "run").rglob("*") if path.is_file()}
    seen: list[ReplaySteps] = []

    def noted(*given: Any, **more: Any) -> ReplaySteps:
        seen.append(ReplaySteps(*given, **more))
        return seen[-1]

    monkeypatch.setattr(replaying, "ReplaySteps", noted)
    again = call("replay", bundle, "--anomaly")
    assert again.code == 1, again.err
    assert "repeated steps 11 to 14" in again.out and "its batch is the same as in the bundle" in again.out
    assert "the failure came again, with the same figures to the bit" in again.out
    assert "Function 'MseLossBackward0'" in again.out or "returned nan values" in again.out
    record = json.loads((bundle / "crash.json").read_text())
    for one in record["steps"][10:13]:  # those before it are equal too, and finite
        assert seen[0].figures[one["step"]] == one["figures"]
    now = {path: path.read_bytes() for path in (recipe.parent / "run").rglob("*") if path.is_file()}
    assert now.keys() == before.keys()
    assert all(now[path] == before[path] for path in before if path.name != ".lock")


def test_a_replay_names_the_layer_that_fails_first(
    call: Call, recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A weight too large for float32: the batch is finite, and so is what comes before that layer."""
    _, bundle = poisoned(call, recipe, "--set", "toy.failure=error")
    path = bundle / "checkpoint.ckpt"
    content = torch.load(path, weights_only=True)
    content["state_dict"]["net.decoder.weight"].fill_(3e38)
    content.pop("sealed")
    torch.save(content, path)
    again = call("replay", bundle, "--anomaly")
    assert again.code == 0 and "but another error did" in again.out


def test_a_replay_of_other_settings_is_refused(call: Call, recipe: Path) -> None:
    _, bundle = poisoned(call, recipe)
    path = bundle.parents[3] / "recipe.yaml"
    path.write_text(path.read_text().replace("lr: 0.01", "lr: 0.02"))
    done = call("replay", bundle)
    assert done.code == 2 and "other settings or inputs now" in done.err
    done = call("replay", bundle.parent)
    assert done.code == 2 and "no crash bundle (no crash.json)" in done.err


def test_an_error_in_a_step_leaves_a_bundle_that_repeats_it(call: Call, recipe: Path) -> None:
    done, bundle = poisoned(call, recipe, "--set", "toy.failure=error")
    assert done.code == 1 and "ArithmeticError: the toy is broken" in done.err
    assert f"step 14 on rank 0 ended with ArithmeticError: the toy is broken; repeat that step with: motionloom " \
        f"replay {bundle}" in done.out  # fmt: skip
    record = json.loads((bundle / "crash.json").read_text())
    assert record["kind"] == "exception" and "in losses" in record["traceback"]
    assert (bundle / "batch.safetensors").is_file()
    again = call("replay", bundle)
    assert again.code == 1 and "the failure came again" in again.out


def test_a_training_that_fails_before_its_first_checkpoint(call: Call, recipe: Path) -> None:
    run = recipe.parent / "run"
    done = call("run", recipe, "-o", run, "--set", "toy.fails_at=2")
    assert done.code == 2
    bundle = run / "stages/toy/crash/step_00000003"
    assert json.loads((bundle / "crash.json").read_text())["checkpoint"] is None
    again = call("replay", bundle)
    assert again.code == 1 and "repeated steps 1 to 3" in again.out
    assert "with the same figures to the bit" in again.out


def test_no_checkpoint_is_made_of_a_network_that_is_lost(call: Call, recipe: Path) -> None:
    """Step 14 fails, a chunk ends with step 15, and a row of the log only with step 20."""
    _, bundle = poisoned(call, recipe)
    kept = sorted(path.name for path in (bundle.parents[1] / "checkpoints").glob("*.ckpt"))
    assert kept == ["step=00000005.ckpt", "step=00000010.ckpt"]


def test_it_goes_on_where_it_is_asked_to(call: Call, recipe: Path) -> None:
    done, bundle = poisoned(call, recipe, "--set", "toy.train.on_not_finite=continue")
    assert done.code == 0 and done.out.count("the loss is not finite") == 1
    assert (bundle / "crash.json").is_file()
    outputs = json.loads((bundle.parents[1] / "artifact.json").read_text())["outputs"]
    assert set(outputs) == {"metrics.jsonl", "model.json", "model.safetensors"}
