"""More steps for a stage: what goes on, what begins anew, and what is said about it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import tiny_adversaries
import torch
from rich.console import Console
from tiny_adversaries import Duel, Vectors
from toy_stages import register_toys

from motionloom.datasets.base.errors import UserError
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, StageContext
from motionloom.pipeline.runs.dry_run import replaced_stages
from motionloom.pipeline.runs.execute import execute
from motionloom.pipeline.runs.plan import make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.training.checkpointing import name_of, read_checkpoint, write_checkpoint
from motionloom.pipeline.training.config import TrainedStageConfig
from motionloom.pipeline.training.trainer import fit


class DuelConfig(TrainedStageConfig):
    """A training with a second optimizer."""

    optim: OptimConfig = tiny_adversaries.GENERATOR
    critic: OptimConfig = tiny_adversaries.GENERATOR
    window: int = 8


DIES_AT: list[int] = []
"""The step at which the next training dies, once."""


def run_duel(context: StageContext) -> None:
    config = context.config
    duel = Duel(seed=context.seed, max_steps=config.train.steps, critic=config.critic)
    dies_at = DIES_AT.pop() if DIES_AT else None
    fit(
        context,
        duel,
        config.train,
        lambda *place: Vectors(*place, dies_at=dies_at),
        lambda: Vectors(4, size=1),
    )
    torch.save(duel.state_dict(), context.folder / "model.pt")


def register(monkeypatch: pytest.MonkeyPatch) -> None:
    root = FunctionStage("root", "nothing", StageConfig, lambda _: None, offers=frozenset({"data"}))
    duel = FunctionStage("duel", "a duel", DuelConfig, run_duel, ("data",), trains=True)
    register_toys(monkeypatch, root, duel)


@pytest.fixture(autouse=True)
def kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


def recipe(folder: Path, *overrides: str) -> Recipe:
    folder.mkdir(exist_ok=True)
    path = folder / "toy.yaml"
    path.write_text(
        "name: toy\nhardware: {accelerator: cpu, devices: 1, threads: 1, loggers: []}\n"
        "stages:\n  data: {kind: root}\n"
        "  duel:\n    kind: duel\n    optim: {lr: 0.01}\n    critic: {lr: 0.01}\n"
        "    train: {steps: 12, batch_size: 4, checkpoint_every: 6, validate_every: 6}\n"
    )
    return load_recipe(path, overrides)


def go(folder: Path, *overrides: str, go_on: Sequence[str] = ()) -> tuple[str, str, str]:
    """Run; what the plan said of the duel, and what was printed."""
    loaded = recipe(folder, *overrides)
    plan = make_plan(loaded, folder / "run", go_on=go_on)
    row = plan[1]
    if row.action != "run" or row.reason == "never run":
        assert replaced_stages(folder / "run", plan) == []
    console = Console(record=True, quiet=False, width=140, file=(folder / "out.txt").open("w"))
    execute(loaded, folder / "run", plan, console)
    return row.action, row.reason, console.export_text()


def outcome(folder: Path) -> dict[str, object]:
    """All that the artifact compares."""
    artifact = Artifact.find(folder / "run/stages/duel")
    assert artifact is not None
    return artifact.dump()


LONG = "duel.train.steps=24"


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """The artifact of a training of 24 steps at once."""
    folder = tmp_path_factory.mktemp("long")
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        go(folder, LONG)
    return outcome(folder)


def test_a_finished_training_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    assert go(tmp_path)[:2] == ("run", "never run")
    action, reason, said = go(tmp_path, LONG)
    assert action == "resume" and reason.startswith("train.steps 12 -> 24: ")
    assert "continues from step 12 of 24" in said and outcome(tmp_path) == long
    assert go(tmp_path, LONG)[0] == "skip"


def test_an_unfinished_training_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    for steps, dies_at in ((12, 8), (18, 14)):
        DIES_AT.append(dies_at)
        with pytest.raises(ConnectionResetError):
            go(tmp_path, f"duel.train.steps={steps}")
        assert Artifact.find(tmp_path / "run/stages/duel") is None
    assert "continues from step 12 of 24" in go(tmp_path, LONG)[2]
    assert outcome(tmp_path) == long


def test_killed_as_it_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    go(tmp_path)
    artifact = tmp_path / "run/stages/duel/artifact.json"
    before = artifact.read_text()
    DIES_AT.append(20)
    with pytest.raises(ConnectionResetError):
        go(tmp_path, LONG)
    assert not artifact.exists(), "nobody takes it for finished"
    artifact.write_text(before)  # as if killed before that
    assert go(tmp_path, LONG)[:2] == ("resume", "started earlier, not finished")
    assert outcome(tmp_path) == long


HALF = "duel.train.precision=bf16-mixed"


def dies(folder: Path, at: int, *overrides: str, **how: Any) -> None:
    DIES_AT.append(at)
    with pytest.raises(ConnectionResetError):
        go(folder, *overrides, **how)


def changes(folder: Path) -> list[tuple[object, ...]]:
    """What the artifact says of settings that changed."""
    artifact = Artifact.find(folder / "run/stages/duel")
    assert artifact is not None
    return [(one.step, one.key, one.old, one.new) for one in artifact.changed]


def test_how_a_step_is_computed_changes_without_being_asked(tmp_path: Path) -> None:
    """Accumulation over the parts of one batch is the same training; each change is told once."""
    dies(tmp_path, 8)
    dies(tmp_path, 8, HALF)  # before another checkpoint, so nothing has been trained like that
    dies(tmp_path, 9)
    action, reason, _ = go(tmp_path, HALF, "duel.train.steps=18")
    assert action == "resume" and "step 6" in reason and "train.precision 32-true -> bf16-mixed" in reason
    assert changes(tmp_path) == [(6, "train.precision", "32-true", "bf16-mixed")]
    assert go(tmp_path, HALF, "duel.train.steps=18")[0] == "skip"
    go(tmp_path, HALF, LONG, "duel.train.accumulate=2")
    assert changes(tmp_path)[1:] == [(18, "train.accumulate", 1, 2)]


KNOWN = ("duel.optim.lr=0.02", "duel.critic.betas=[0.8,0.95]", "duel.train.batch_size=2")


def test_what_a_step_computes_changes_when_it_is_asked_for(tmp_path: Path) -> None:
    """Weights and moments are kept, under the new settings."""
    dies(tmp_path, 8)
    row = make_plan(recipe(tmp_path, *KNOWN), tmp_path / "run")[1]
    assert row.action == "run" and row.goes_on is not None and row.goes_on.step == 6
    go(tmp_path, *KNOWN, go_on=["duel"])
    assert changes(tmp_path) == [
        (6, "critic.betas", [0.9, 0.99], [0.8, 0.95]),
        (6, "optim.lr", 0.01, 0.02),
        (6, "train.batch_size", 4, 2),
    ]
    folder = tmp_path / "run/stages/duel/checkpoints"
    states = read_checkpoint(folder / name_of(12))["optimizer_states"]
    assert states[1]["param_groups"][0]["betas"] == (0.8, 0.95)
    assert states[0]["state"][0]["step"] == 12 and len(states[0]["state"]) == 4
    assert go(tmp_path, *KNOWN)[0] == go(tmp_path, *KNOWN, go_on=["duel"])[0] == "skip"


@pytest.mark.parametrize(
    ("overrides", "go_on", "says"),
    [
        (["seed=4"], "duel", "seed"),
        (["duel.window=9"], "duel", "window 8 -> 9"),
        (["duel.optim.lr=1"], "dual", "'duel'"),
        (["duel.optim.lr=1"], "data", "trains nothing"),
        (["duel.optim.lr=1", "duel.train.steps=6"], "duel", r"step 6 .*duel\.train\.steps"),
    ],
)
def test_what_cannot_go_on_says_why(overrides: list[str], go_on: str, says: str, tmp_path: Path) -> None:
    dies(tmp_path, 8)
    with pytest.raises(UserError, match=says):
        make_plan(recipe(tmp_path, *overrides), tmp_path / "run", go_on=[go_on])


def test_an_average_begins_or_ends_where_it_is_asked_for(tmp_path: Path) -> None:
    """`--go-on` takes both; a checkpoint holds one where there is one."""
    dies(tmp_path, 8)
    go(tmp_path, "duel.train.ema=0.9", "duel.train.steps=7", go_on=["duel"])
    folder = tmp_path / "run/stages/duel/checkpoints"
    state = read_checkpoint(folder / name_of(7))
    assert state["average"] is not None and state["average"]["n_averaged"] == 1
    go(tmp_path, "duel.train.ema=null", "duel.train.steps=9", go_on=["duel"])
    assert read_checkpoint(folder / name_of(9))["average"] is None
    assert (7, "train.ema", 0.9, None) in changes(tmp_path)


def test_what_cannot_be_loaded_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a finished training nor one that is not."""
    for ends in (True, False):
        folder = tmp_path / str(ends)
        go(folder) if ends else dies(folder, 8)
        stage = folder / "run/stages/duel"
        before = {path: path.read_bytes() for path in stage.rglob("*") if path.is_file()}
        with monkeypatch.context() as patch, pytest.raises(UserError, match="another network than duel"):
            patch.setattr(tiny_adversaries, "DIM", 5)
            go(folder, LONG, "duel.optim.lr=0.02", go_on=["duel"])
        assert {path: path.read_bytes() for path in before} == before
        assert go(folder)[0] == ("skip" if ends else "resume") and changes(folder) == []


@pytest.mark.parametrize("more", [(), ("duel.optim.schedule=cosine",)])
def test_what_was_to_be_trained_further_by_mistake_is_finished_again(
    tmp_path: Path, more: tuple[str, ...]
) -> None:
    go(tmp_path, *more)
    before = outcome(tmp_path)
    dies(tmp_path, 12, LONG, *more)
    assert Artifact.find(tmp_path / "run/stages/duel") is None
    assert go(tmp_path, *more)[0] == "resume" and outcome(tmp_path) == before
    # So is a rate that nothing was trained with.
    dies(tmp_path, 12, LONG, *more, "duel.optim.lr=0.5", go_on=["duel"])
    assert go(tmp_path, *more)[0] == "resume" and outcome(tmp_path) == before


def test_two_ways_to_turn_an_average_off_are_one(tmp_path: Path) -> None:
    go(tmp_path)
    assert go(tmp_path, "duel.train.ema=0")[0] == "skip"


def test_another_network_in_the_checkpoint_is_named(tmp_path: Path) -> None:
    dies(tmp_path, 8)
    path = tmp_path / "run/stages/duel/checkpoints" / name_of(6)
    content = {**read_checkpoint(path)}
    content["state_dict"] = {**content["state_dict"], "net.0.weight": torch.zeros(2, 2)}
    write_checkpoint(content, path)
    with pytest.raises(UserError, match=r"step=00000006\.ckpt: .*net\.0\.weight"):
        go(tmp_path)


COSINE = "duel.critic.schedule=cosine"


def test_what_differs_in_more_or_has_nothing_to_go_on_from_begins_anew(tmp_path: Path) -> None:
    def planned(*overrides: str) -> tuple[str, str]:
        row = make_plan(recipe(tmp_path, *overrides), tmp_path / "run")[1]
        return row.action, row.reason

    go(tmp_path)
    for overrides, reason in (
        (["duel.train.steps=6"], "changed: train.steps 12 -> 6"),
        ([LONG, "duel.optim.lr=0.5"], "changed: optim.lr 0.01 -> 0.5 (+1 more)"),
        (["duel.train.precision=bf16-mixed"], "changed: train.precision 32-true -> bf16-mixed"),
        ([LONG, "seed=4"], "changed: train.steps 12 -> 24"),
    ):
        assert planned(*overrides) == ("run", reason)
    folder = tmp_path / "run/stages/duel"
    started = json.loads((folder / "started.json").read_text())
    (folder / "started.json").write_text(json.dumps({"fingerprint": started["fingerprint"]}))
    assert planned(LONG)[0] == "run"
    (folder / "started.json").write_text("{")
    with pytest.raises(UserError, match=r"started\.json: not valid JSON .*; delete that file"):
        planned(LONG)
    (folder / "started.json").write_text(json.dumps(started))
    assert planned(LONG)[0] == "resume"
    shutil.rmtree(folder / "checkpoints")
    assert planned(LONG)[0] == "run"


def test_a_schedule_of_that_length_is_lengthened_and_noted(tmp_path: Path) -> None:
    """Killed on the way it goes on as if nothing had been; begun at 24 steps it is another training."""
    once = tmp_path / "once"
    for folder, killed in ((tmp_path, False), (once, True)):
        go(folder, COSINE)
        if killed:
            DIES_AT.append(20)
            with pytest.raises(ConnectionResetError):
                go(folder, COSINE, LONG)
        action, reason, _ = go(folder, COSINE, LONG)
        assert action == "resume" and (killed or "critic.schedule cosine now ends with step 24" in reason)
    assert outcome(tmp_path) == outcome(once) and [
        (one["step"], one["key"], one["old"], one["new"]) for one in outcome(tmp_path)["changed"]
    ] == [(12, "train.steps", 12, 24)]
    go(tmp_path / "whole", COSINE, LONG)
    assert outcome(tmp_path / "whole") != outcome(once)
