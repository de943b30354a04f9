"""More steps for a stage: what goes on, what begins anew, and what is said about it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import tiny_adversaries
import torch
from rich.console import Console
from tiny_adversaries import Duel, Vectors
from toy_stages import register_toys

from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, StageContext
from motionloom.pipeline.runs.dry_run import replaced_stages, started_trainings
from motionloom.pipeline.runs.execute import execute
from motionloom.pipeline.runs.plan import make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.training.config import TrainedStageConfig
from motionloom.pipeline.training.trainer import fit


class DuelConfig(TrainedStageConfig):
    """A training with a second optimizer."""

    optim: OptimConfig = tiny_adversaries.GENERATOR
    critic: OptimConfig = tiny_adversaries.GENERATOR


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
        lambda batch, rank, world: Vectors(batch, rank, world, dies_at=dies_at),
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
    assert "step 12 to 24" in said and outcome(tmp_path) == long
    assert go(tmp_path, LONG)[0] == "skip"


def test_an_unfinished_training_goes_on(tmp_path: Path, long: dict[str, object]) -> None:
    for steps, dies_at in ((12, 8), (18, 14)):
        DIES_AT.append(dies_at)
        with pytest.raises(ConnectionResetError):
            go(tmp_path, f"duel.train.steps={steps}")
        assert Artifact.find(tmp_path / "run/stages/duel") is None
    assert "step 12 to 24" in go(tmp_path, LONG)[2]
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


COSINE = "duel.critic.schedule=cosine"


def test_what_differs_in_more_or_has_nothing_to_go_on_from_begins_anew(tmp_path: Path) -> None:
    def planned(*overrides: str) -> tuple[str, str]:
        row = make_plan(recipe(tmp_path, *overrides), tmp_path / "run")[1]
        return row.action, row.reason

    go(tmp_path)
    for overrides, reason in (
        (["duel.train.steps=6"], "changed: train.steps 12 -> 6"),
        ([LONG, "duel.optim.lr=0.5"], "changed: optim.lr 0.01 -> 0.5 (+1 more)"),
        ([LONG, "seed=4"], "changed: train.steps 12 -> 24"),
    ):
        assert planned(*overrides) == ("run", reason)
    folder = tmp_path / "run/stages/duel"
    started = json.loads((folder / "started.json").read_text())
    (folder / "started.json").write_text(json.dumps({"fingerprint": started["fingerprint"]}))
    assert planned(LONG)[0] == "run"
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
        assert action == "resume" and (killed or "critic.schedule cosine is lengthened" in reason)
    assert outcome(tmp_path) == outcome(once) and outcome(tmp_path)["lengthened"] == [12]
    go(tmp_path / "whole", COSINE, LONG)
    assert outcome(tmp_path / "whole") != outcome(once)
