"""More steps for a stage: what goes on, what begins anew, and what is said about it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import tiny_players
import torch
from rich.console import Console
from tiny_players import Duel, Vectors
from toy_stages import register_toys

from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, StageContext
from motionloom.pipeline.runs.graph import execute, make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.runs.replace import replaced_stages, started_trainings
from motionloom.pipeline.stages.train_config import TrainedStageConfig
from motionloom.pipeline.stages.training import fit
from motionloom.pipeline.store.artifact import Artifact


class DuelConfig(TrainedStageConfig):
    """A training with a second optimizer."""

    optim: OptimConfig = tiny_players.GENERATOR
    critic: OptimConfig = tiny_players.GENERATOR


class Seconds(Duel):
    """Dies once at the step that the test says."""

    dies_at: int | None = None


def run_duel(context: StageContext) -> None:
    config = context.config
    duel = Duel(seed=context.seed, max_steps=config.train.steps, critic=config.critic)
    dies_at, Seconds.dies_at = Seconds.dies_at, None
    fit(
        context,
        duel,
        config.train,
        lambda batch, rank, world: Vectors(batch, rank, world, dies_at=dies_at),
        lambda: Vectors(4, size=1),
        0.0,
    )
    torch.save(duel.state_dict(), context.folder / "model.pt")


class AnyConfig(StageConfig):
    """No settings."""


@pytest.fixture(autouse=True)
def kinds(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    root = FunctionStage("root", "nothing", AnyConfig, lambda _: None, given_names=frozenset({"data"}))
    duel = FunctionStage("duel", "a duel", DuelConfig, run_duel, ("data",), trains=True)
    register_toys(monkeypatch, root, duel)
    yield


def recipe(folder: Path, *overrides: str) -> Recipe:
    path = folder / "toy.yaml"
    path.write_text(
        "name: toy\nhardware: {accelerator: cpu, devices: 1, threads: 1, loggers: []}\n"
        "stages:\n  data: {kind: root}\n"
        "  duel:\n    kind: duel\n    optim: {lr: 0.01}\n    critic: {lr: 0.01}\n"
        "    train: {steps: 12, batch_size: 4, checkpoint_every: 6, validate_every: 6}\n"
    )
    return load_recipe(path, overrides)


def go(folder: Path, *overrides: str) -> tuple[str, str, str]:
    """Run; what the plan said of the duel, and what was printed."""
    loaded = recipe(folder, *overrides)
    plan = make_plan(loaded, folder / "run")
    row = plan[1]
    if row.action != "run" or row.reason == "never run":
        assert replaced_stages(folder / "run", plan) == started_trainings(folder / "run", plan) == []
    console = Console(record=True, quiet=False, width=140, file=(folder / "out.txt").open("w"))
    execute(loaded, folder / "run", plan, console)
    return row.action, row.reason, console.export_text()


def outcome(folder: Path) -> dict[str, object]:
    """All that the artifact compares."""
    artifact = Artifact.find(folder / "run/stages/duel")
    assert artifact is not None
    return artifact.dump()


LONG = "duel.train.steps=24"


@pytest.fixture
def long(tmp_path: Path) -> dict[str, object]:
    """The artifact of a training of 24 steps at once."""
    (tmp_path / "long").mkdir()
    go(tmp_path / "long", LONG)
    return outcome(tmp_path / "long")


def test_a_finished_training_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    assert go(tmp_path)[:2] == ("run", "never run")
    action, reason, said = go(tmp_path, LONG)
    assert action == "resume" and reason == "train.steps 12 -> 24: goes on from its last checkpoint"
    assert "duel goes on from step 12 to 24" in said
    assert outcome(tmp_path) == long
    assert go(tmp_path, LONG)[0] == "skip"


def test_an_unfinished_training_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    for steps, dies_at in ((12, 8), (18, 14)):
        Seconds.dies_at = dies_at
        with pytest.raises(ConnectionResetError):
            go(tmp_path, f"duel.train.steps={steps}")
        assert Artifact.find(tmp_path / "run/stages/duel") is None
    assert "goes on from step 12 to 24" in go(tmp_path, LONG)[2]
    assert outcome(tmp_path) == long


def test_killed_as_it_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    go(tmp_path)
    folder = tmp_path / "run/stages/duel"
    before = (folder / "artifact.json").read_text()
    Seconds.dies_at = 20
    with pytest.raises(ConnectionResetError):
        go(tmp_path, LONG)
    assert not (folder / "artifact.json").exists(), "nobody takes it for finished"
    (folder / "artifact.json").write_text(before)  # as if killed before that
    assert go(tmp_path, LONG)[:2] == ("resume", "started earlier, not finished")
    assert outcome(tmp_path) == long


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        (["duel.train.steps=6"], "changed: train.steps 12 -> 6"),
        ([LONG, "duel.optim.lr=0.5"], "changed: optim.lr 0.01 -> 0.5 (+1 more)"),
        ([LONG, "seed=4"], "changed: train.steps 12 -> 24"),
    ],
)
def test_what_differs_in_more_begins_anew(tmp_path: Path, overrides: list[str], reason: str) -> None:
    go(tmp_path)
    action, why, said = go(tmp_path, *overrides)
    assert (action, why) == ("run", reason) and "goes on" not in said


def test_a_schedule_of_that_length_begins_anew(tmp_path: Path) -> None:
    cosine = "duel.critic.schedule=cosine"
    go(tmp_path, cosine)
    action, reason, said = go(tmp_path, cosine, LONG)
    assert action == "run"
    assert reason == "changed: train.steps 12 -> 24, and critic.schedule cosine depends on it"
    assert "goes on" not in said


def test_without_checkpoints_or_of_an_older_version_it_begins_anew(tmp_path: Path) -> None:
    go(tmp_path)
    folder = tmp_path / "run/stages/duel"
    started = json.loads((folder / "started.json").read_text())
    (folder / "started.json").write_text(json.dumps({"fingerprint": started["fingerprint"]}))
    assert make_plan(recipe(tmp_path, LONG), tmp_path / "run")[1].action == "run"
    (folder / "started.json").write_text(json.dumps(started))
    assert make_plan(recipe(tmp_path, LONG), tmp_path / "run")[1].action == "resume"
    shutil.rmtree(folder / "checkpoints")
    assert make_plan(recipe(tmp_path, LONG), tmp_path / "run")[1].action == "run"
