"""Trainings that are not finished, used by every command (`--at`), and samples drawn beside them."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from rich.console import Console
from safetensors.torch import load_file

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.stage import StageCache, StageContext, stage_kind
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.execute import draws_motions
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.samples import draw_samples
from motionloom.pipeline.runs.snapshot import _asked_first, run_at
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.training import telemetry
from motionloom.pipeline.training.checkpointing import readable

MODEL = ("artifact.json", "model.json", "model.safetensors")
ASKED: dict[str, Any] = {"captions": ["a person waves", "a person bows"], "seconds": 2, "seed": 5}


def cut(run: Path, target: Path, *stages: str) -> Path:
    """A copy of a run in which trainings are at their last step and not finished; nothing is below them."""
    shutil.copytree(run, target)
    for name in stages:
        for file in MODEL:
            (target / "stages" / name / file).unlink()
    for name in ("ude", "generate", "evaluate", "report"):
        shutil.rmtree(target / "stages" / name, ignore_errors=True)
    return target


@pytest.fixture(scope="module")
def begun(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cut(small_run.folder, tmp_path_factory.mktemp("begun") / "small", "gpt", "face_gpt")


def drawn(folder: Path | str, **more: Any) -> list[Any]:
    return MotionModel(folder, "cpu").generate(**ASKED, **more)


def assert_same(ours: list[Any], theirs: list[Any]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        assert (one.joints == other.joints).all()
        assert one.face is None or (one.face == other.face).all()


def test_the_last_checkpoint_is_the_finished_model(
    begun: Path, small_run: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the averaged weights where there are any."""
    with run_at(begun, "newest") as folder:
        assert_same(drawn(folder, face=["a happy face"]), drawn(small_run.folder, face=["a happy face"]))
        for name in ("gpt", "face_gpt"):
            made, whole = (load_file(run / "stages" / name / MODEL[2]) for run in (folder, small_run.folder))
            assert made.keys() == whole.keys() and all(torch.equal(made[k], whole[k]) for k in made)
    assert not folder.exists()
    said = re.findall(r"(\w+) at step (\d+) of (\d+)(, averaged)?", capsys.readouterr().err)
    assert said == [("gpt", "30", "30", ""), ("face_gpt", "8", "8", ", averaged")]
    trained = next(readable(begun / "stages/face_gpt/checkpoints"))[1]["state_dict"]
    assert any(not torch.equal(trained[f"net.{name}"], value) for name, value in whole.items())
    with run_at(small_run.folder, "newest") as folder:
        assert folder == small_run.folder, "all is finished"


def test_a_generator_of_several_trainings(ude_run: Any, tmp_path: Path, call: Any) -> None:
    """It trains nothing itself, and is made of what is there."""
    run = cut(ude_run.folder, tmp_path / "run", "dmd")
    with run_at(run, "newest") as folder:
        assert_same(drawn(folder), drawn(ude_run.folder))
    done = call("evaluate", run, "--at", "newest", "--clips", 2)
    assert done.code == 0, done.err
    assert (run / "at/run-dmd-8/evaluate/metrics.json").is_file()
    # Before the last of them has a checkpoint nothing dances, and the rest is measured.
    shutil.rmtree(cut(run, tmp_path / "early", "utt") / "stages/dmd/checkpoints")
    early = tmp_path / "early"
    done = call("generate", early, "a person waves", "--at", "newest", "-o", tmp_path / "made")
    assert done.code == 2 and f"error: {early}: no finished stage" in done.err and "dmd" in done.err
    done = call("evaluate", early, "--at", "newest", "--clips", 2)
    assert done.code == 0, done.err


def test_every_command(begun: Path, small_run: Any, tmp_path: Path, call: Callable[..., Any]) -> None:
    note = begun / "stages/gpt/started.json"
    changed = [{"step": step, "key": "optim.lr", "old": 1, "new": 2} for step in (12, 24)]
    note.write_text(json.dumps({**json.loads(note.read_text()), "changed": changed}))
    before = sorted(begun.rglob("*"))
    for command in (("generate", begun, "a person waves"), ("evaluate", begun)):
        assert (done := call(*command)).code == 2 and "--at newest" in done.err
    for step in ("7", "gpt:8", "yesterday"):
        done = call("export", begun, "--at", step, "-o", tmp_path / "none")
        assert done.code == 2 and "gpt: 24, 30" in done.err and not (tmp_path / "none").exists()
    assert call("caption", begun, tmp_path, "--at", "30").code == 2
    assert "gpt at step 24 of 30" in call("export", begun, "--at", "gpt:24", "-o", tmp_path / "model").err
    artifact = Artifact.find(tmp_path / "model/gpt")
    assert artifact is not None and artifact.step == 24
    assert [change.step for change in artifact.changed] == [12], "those of later steps are not in it"
    assert before == sorted(begun.rglob("*"))
    with run_at(small_run.folder, "24") as folder:  # of a training that is finished
        assert_same(drawn(tmp_path / "model"), drawn(folder))
    assert call("evaluate", begun, "--at", "newest").code == 0
    assert call("report", begun, "--at", "newest").code == 0
    place = begun / "at/small-gpt-30"
    figures, finished = (
        json.loads((folder / "metrics.json").read_text())["figures"]
        for folder in (place / "evaluate", small_run.folder / "stages/evaluate")
    )
    assert figures == finished
    assert "generated" in (place / "report/report.html").read_text()


def test_what_a_training_was_not_made_from_is_refused(begun: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(begun, run)
    path = run / "stages/tokens/artifact.json"
    path.write_text(path.read_text().replace('"fingerprint": "', '"fingerprint": "0', 1))
    with pytest.raises(UserError, match="another 'tokens'"), run_at(run, "newest"):
        pass
    shutil.rmtree(run / "stages/gpt/checkpoints")
    shutil.rmtree(run / "stages/face_gpt/checkpoints")
    with run_at(run, "newest") as folder:
        assert folder == run, "all that has begun is finished"
    with pytest.raises(UserError, match="--at 7"), run_at(run, "7"):
        pass
    with pytest.raises(UserError, match=r"synthetic .*leave --at out"), run_at("synthetic", "newest"):
        pass


@pytest.mark.timeout(1500)  # both processes wait for the cores where others use them
def test_while_it_trains(small_run: Any, start: Callable[..., Any], tmp_path: Path, call: Any) -> None:
    """Its checkpoints come and go every two steps; samples are drawn meanwhile, and the report has them."""
    recipe, run = yaml.safe_load(small_run.recipe.read_text()), tmp_path / "run"
    recipe["stages"]["gpt"]["train"] |= {"steps": 10**6, "checkpoint_every": 2, "sample_every": 3}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(recipe))
    shutil.copytree(small_run.folder, run)
    process = start("run", tmp_path / "small.yaml", "-o", run, "--until", "gpt", "--replace")
    figures = run / "stages/gpt/samples/figures.jsonl"
    steps: list[Any] = []
    try:
        while len(steps) < 3 or not figures.is_file():
            assert process.poll() is None, process.communicate()[0]
            if not (run / "stages/gpt/artifact.json").exists():
                with run_at(run, "newest") as folder:
                    steps.append(Artifact.find(folder / "stages/gpt").step)  # type: ignore[union-attr]
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.communicate()
    assert steps == sorted(steps) and steps[-1] > 30
    row = json.loads(figures.read_text().splitlines()[0])
    assert row["recorded/agreement.everything"] == 1 and row["drawn/position.ape_joints"] > 0
    motions = figures.parent / f"step={row['step']:08d}"
    assert (motions / "index.html").is_file() and list(motions.glob("*.npz"))
    done = call("report", run)
    page = (run / "report/report.html").read_text()
    assert done.code == 0 and "gpt: position.ape_joints" in page
    assert f'"step {json.loads(figures.read_text().splitlines()[-1])["step"]:,}"' in page


def test_samples_of_dances(ude_run: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(ude_run.folder, run)
    out = draw_samples(run, "utt")
    assert out.name == "step=00000012" and list(out.glob("*.npz"))


def test_what_is_asked_for_is_the_first_generator() -> None:
    """Of a run of many, also where others are not finished either."""
    recipe = load_recipe("baselines-tiny-ude")
    makers = {one.name for one in recipe.stages if "generator" in one.kind.gives(one.config)}
    for asked in sorted({"utt", "dmd"} | makers - {"ude"}):
        # What it was trained with is finished, and comes from outside.
        above = {one.name for one in recipe.above(recipe.stage(asked))}
        stages = [one for one in recipe.stages if one.name not in above]
        ordered = _asked_first(stages, asked)
        names = [one.name for one in ordered]
        assert sorted(names) == sorted(one.name for one in stages)
        for place, one in enumerate(ordered):
            assert not set(names[place:]) & set(one.inputs.values())
        first = next(one for one in ordered if one.name in makers)
        assert asked == first.name or asked in first.inputs.values()
        every = recipe.stage("generate").inputs.values(), ordered[names.index("generate")].inputs.values()
        assert sorted(every[0]) == sorted(every[1])
        assert next(name for name in every[1] if name in makers - above) == first.name


def test_the_one_before_a_damaged_checkpoint(begun: Path, tmp_path: Path, call: Callable[..., Any]) -> None:
    run = shutil.copytree(begun, tmp_path / "run")
    last, before = sorted((run / "stages/gpt/checkpoints").glob("*.ckpt"), reverse=True)[:2]
    last.write_bytes(last.read_bytes()[:-50])
    step = int(before.stem.partition("=")[2])
    with run_at(run, "newest") as folder:
        artifact = Artifact.find(folder / "stages/gpt")
    assert artifact is not None and artifact.step == step
    with pytest.raises(UserError, match=r"damaged; take another one"), run_at(run, "gpt:30"):
        pass


def test_trainings_that_motions_are_drawn_of() -> None:
    """UDE's last one, since `ude`, which generates, trains nothing."""
    for name, wanted in (("humantomato-tiny", {"gpt", "face_gpt"}), ("ude-tiny", {"dmd"})):
        recipe = load_recipe(name)
        assert {one.name for one in recipe.stages if one.kind.trains and draws_motions(recipe, one)} == wanted


def test_a_drawing_that_fails_is_one_warning(tmp_path: Path) -> None:
    failing = (sys.executable, "-P", "-m", "motionloom.no_such_module")
    console = Console(file=io.StringIO(), width=200)
    for name, draws in (("gpt", failing), ("tma", ())):
        folder, kind = tmp_path / "stages" / name, stage_kind(name, "")
        context = StageContext(
            name, "", kind.config(), folder, {}, 0, Hardware(), console, StageCache(), draws=draws
        )
        process = telemetry.SampleProcess(context, 2)
        for step in range(1, 9):
            process.saved(step)
            if process._process is not None:
                assert name == "gpt" and process._process.wait() == 1
    assert isinstance(console.file, io.StringIO) and console.file.getvalue().count("log.txt") == 1
    assert "no_such_module" in (tmp_path / "stages/gpt/samples/log.txt").read_text()
