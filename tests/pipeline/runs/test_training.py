"""`training`: a stage's module and batches for `lightning.Trainer`, and modules from checkpoints."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from plain_training import StopAt, trainer
from rank_shares import require_rows
from safetensors.torch import load_file

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.plan import ALONE
from motionloom.models.tma.module import TmaModule
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.training import finish, training
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.training.loaders import StageData

SMALL = ["tokenizer", "face_tokenizer", "tma", "gpt", "face_gpt", "face_vae", "face_diffusion"]


def fitted(module: StageModule, data: StageData, steps: int, folder: Path, start: Any = None) -> L.Trainer:
    """A Trainer that has trained for some steps of those that the recipe has, and validated."""
    one = trainer(folder, max_steps=module.max_steps, callbacks=[StopAt(steps)])
    one.fit(module, data, ckpt_path=start)
    return one


@pytest.mark.parametrize("stage", [*SMALL, "utt", "dmd"])
def test_a_trainer_makes_the_weights_of_the_run(stage: str, request: Any, tmp_path: Path) -> None:
    """Bit for bit those of the run's first checkpoint that is left, and from there those of the run, with
    their average where there is one; and both kinds of checkpoint load."""
    run = request.getfixturevalue("small_run" if stage in SMALL else "ude_run").folder
    first = min((run / "stages" / stage / "checkpoints").glob("*.ckpt"))
    wanted = torch.load(first, weights_only=True)
    module, data = training(run, stage)
    one = fitted(module, data, wanted["global_step"], tmp_path)
    assert one.callback_metrics["val/loss"].isfinite()
    averaged = {f"net{name[6:]}": value for name, value in (wanted["average"] or {}).items()}
    for name, value in module.state_dict().items():
        assert torch.equal(value, (wanted["state_dict"] | averaged)[name]), name
    again, same = training(run, stage)
    fitted(again, same, again.max_steps, tmp_path, first)
    for name, value in load_file(run / "stages" / stage / "model.safetensors").items():
        assert torch.equal(value, again.net.state_dict()[name]), name
    one.save_checkpoint(tmp_path / "trainer.ckpt")
    batches = data.batches.train(8, ALONE)
    batch = batches[0]
    require_rows(batch, [pickle.loads(pickle.dumps(batches))[0]])  # a loader's worker gets a copy
    losses = []
    for loaded in (StageModule.load_from_checkpoint(path) for path in (first, tmp_path / "trainer.ckpt")):
        assert type(loaded) is type(module) and loaded.hparams["config"] == module.hparams["config"]
        torch.manual_seed(0)
        losses.append(loaded.eval().losses(batch)["loss"])
    assert losses[0].isfinite() and torch.equal(losses[0], losses[1])


def test_checkpoints_follow_their_run(small_run: Any, tmp_path: Path) -> None:
    """A run that was moved; a Trainer's checkpoint whose run was; one of another class; one built by hand."""
    moved = tmp_path / "moved"
    shutil.copytree(small_run.folder, moved)
    own = min((moved / "stages/tma/checkpoints").glob("*.ckpt"))
    module = TmaModule.load_from_checkpoint(own)
    path = tmp_path / "trainer.ckpt"
    with pytest.raises(TypeError, match="TmaModule"):
        type(training(moved, "gpt")[0]).load_from_checkpoint(own)
    content = torch.load(own, weights_only=True)
    content["hyper_parameters"]["inputs"] = {"data": "/gone", "stats": "/gone", "text": "/gone"}
    torch.save(content, path)
    with pytest.raises(UserError, match=r"trainer\.ckpt.*/gone.*inputs"):
        TmaModule.load_from_checkpoint(path)
    places = {role: moved / "stages" / role for role in ("data", "stats", "text")}
    again = TmaModule.load_from_checkpoint(path, inputs=places)
    by_hand = TmaModule.load_from_checkpoint(
        own, net=again.net, optim=again.optim_config, seed=0, max_steps=10, loss=again.loss_config
    )
    for other in (again, by_hand):
        for name, value in module.state_dict().items():
            assert torch.equal(value, other.state_dict()[name]), name
    del content["hyper_parameters"]
    torch.save(content, path)
    with pytest.raises(UserError, match="net="):
        TmaModule.load_from_checkpoint(path)


def test_a_recipe_makes_what_the_stage_needs(
    small_run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    changes = [
        "data.clips=24",
        "tokenizer.train.steps=2",
        "tokenizer.optim={schedule: cosine, warmup_steps: 0}",
    ]
    module, data = training(small_run.recipe, "tokenizer", changes)
    assert sorted(path.parent.name for path in tmp_path.glob("runs/small/stages/*/artifact.json")) == [
        "data",
        "stats",
    ]
    assert data.hardware.workers == 0, "a script without a guard would be run anew by each"
    assert module.max_steps == 2 and fitted(module, data, 2, tmp_path).global_step == 2
    assert module.schedule.get_last_lr() == [0.0], "the cosine has ended"
    with pytest.raises(UserError, match="has its stage 'data' already"):
        training(small_run.folder, "tokenizer", ["data.clips=24"])
    assert training(small_run.folder, "tokenizer", ["tma.train.steps=3", "tokenizer.train.steps=3"])
    with pytest.raises(UserError, match="'text' is not finished"):
        training(tmp_path / "runs/small", "gpt")
    with pytest.raises(UserError, match=r"'stats'.*trains nothing"):
        training(small_run.folder, "stats")


def test_what_a_trainer_trained_is_a_stage_of_the_run(small_run: Any, tmp_path: Path) -> None:
    """Its bytes are those of the run's own; later stages, plans, motions and exports take it."""
    run = tmp_path / "run"
    shutil.copytree(small_run.folder, run, ignore=shutil.ignore_patterns("checkpoints"))
    own = run / "stages/tokenizer"
    wanted = load_file(own / "model.safetensors")
    with pytest.raises(UserError, match="is finished"):
        finish(training(run, "tokenizer")[0], run, "tokenizer")
    shutil.rmtree(own)
    module, data = training(run, "tokenizer")
    for wrong, words in (
        (training(run, "tokenizer", ["tokenizer.train.steps=3"])[0], r"another train\.steps"),
        (training(run, "tma")[0], "of kind tma"),
        (TmaModule(training(run, "tma")[0].net, module.optim_config, seed=0, max_steps=1), "no settings"),
    ):
        with pytest.raises(UserError, match=words):
            finish(wrong, run, "tokenizer")
    fitted(module, data, module.max_steps, tmp_path)
    assert finish(module, run, "tokenizer") == own
    found = load_file(own / "model.safetensors")
    assert found.keys() == wanted.keys() and all(torch.equal(found[name], wanted[name]) for name in wanted)
    artifact = Artifact.load_json(own / "artifact.json")
    assert artifact.trained_by == f"lightning.Trainer, {module.max_steps} steps"
    plan = make_plan(load_recipe(run / "recipe.yaml"), run)
    assert {row.action for row in plan if row.stage.name in ("tokenizer", "tokens", "gpt")} == {"skip"}
    assert run_recipe(run / "recipe.yaml", run, select=None) == run
    assert MotionModel.from_pretrained(run).generate(["walks"], seed=0)
