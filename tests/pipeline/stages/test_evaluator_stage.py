"""The trained evaluator: it learns, goes on after a kill, trains on two processes, judges, and refuses."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.numpy import load_file

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import Given, Shelf
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.evaluation.text_motion import matching
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.stages.evaluator import EvaluatorStage, EvaluatorStageConfig
from motionloom.pipeline.store.evaluator import LoadedEvaluator, StageWords
from motionloom.pipeline.store.weights import load_facts

RECIPE = """
name: judge
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data:
    kind: synth
    clips: 300
    layout: body133
    min_seconds: 2.0
    max_seconds: 5.0
    actions: [walk, turn, squat, kick, raise]
    test_fraction: 0.2
  stats: {kind: stats}
  text: {kind: text}
  evaluator:
    kind: evaluator
    net: {movement_hidden: 64, movement: 64, motion_hidden: 64, text_hidden: 64, latent: 32}
    optim: {lr: 1.0e-3}
    movement_optim: {lr: 1.0e-3, schedule: cosine}
    movement_steps: 60
    train: {steps: 240, batch_size: 32, checkpoint_every: 60, validate_every: 120}
"""

SHORT = """
extends: judge
name: judge
stages:
  evaluator:
    net: {dropout: DROPOUT, motion_hidden: 16, text_hidden: 16, movement: 16, movement_hidden: 16}
    movement_steps: 6
    train: {steps: 16, batch_size: 8, checkpoint_every: 4, validate_every: 8}
"""

JUDGED = """
extends: judge
name: judge
stages:
  evaluator: {movement_steps: 2, train: {steps: 4, validate_every: 0}}
  temos:
    kind: tma
    net: {latent: 8, ff: 16, layers: 1, heads: 2}
    loss: {contrastive: 0.0}
    train: {steps: 2, batch_size: 4, validate_every: 0}
  evaluate:
    kind: evaluate
    clips: 24
    repeats: 3
    size: 8
    lengths: recorded
    inputs: {tma: null, generators: [temos]}
"""


@pytest.fixture(scope="module")
def judge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the recipe and its finished run."""
    root = tmp_path_factory.mktemp("judge")
    (root / "judge.yaml").write_text(RECIPE)  # the others extend it
    run_recipe(root / "judge.yaml", root / "run", console=Console(quiet=True))
    return root


def loaded(run: Path) -> tuple[Any, LoadedEvaluator]:
    """Data and evaluator of a run."""
    stages, shelf = finished_stages(run), Shelf()
    return shelf.get(stages["data"]), shelf.get(stages["evaluator"])


def metrics(run: Path) -> list[dict[str, float]]:
    lines = (run / "stages/evaluator/metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.mark.slow
def test_it_finds_the_motion_of_a_caption(judge: Path) -> None:
    """Of 32 clips never trained on. A guess is right in 9 % of cases within three."""
    data, evaluator = loaded(judge / "run")
    test = data.split("test")
    truths = [truth_of(test, i) for i in range(len(test))]
    latents = Judge.evaluator(evaluator).latents(truths, [], truths[:8])
    found = matching(replace(latents, made=[latents.real]), size=32, repeats=20, seed=0)
    assert found["chance"]["top-3"] == pytest.approx(3 / 32)
    assert found["real"]["top-3"].mean > 0.6, found["real"]
    assert found["mean_pose"]["top-3"].mean < 0.25
    assert found["real"]["matching_score"].mean < 0.5 * found["mean_pose"]["matching_score"].mean


@pytest.mark.slow
def test_movements_come_first_and_then_stay(judge: Path) -> None:
    rows = metrics(judge / "run")
    movement = [row for row in rows if "train/movement_reconstruction" in row]
    pairs = [row for row in rows if "train/matching_loss" in row]
    assert max(row["step"] for row in movement) == 60 < min(row["step"] for row in pairs)
    assert movement[-1]["train/movement_reconstruction"] < 0.8 * movement[0]["train/movement_reconstruction"]
    weights = []
    for name in ("step=00000180.ckpt", "step=00000240.ckpt"):
        checkpoint = torch.load(judge / "run/stages/evaluator/checkpoints" / name, weights_only=True)
        weights.append(checkpoint["state_dict"])
        rates = [state["param_groups"][0]["lr"] for state in checkpoint["optimizer_states"]]
        assert rates[0] < 0.01 * rates[1] == pytest.approx(1e-5), "its schedule ends where its turns do"
    for name, value in weights[0].items():
        assert torch.equal(value, weights[1][name]) == ("movement_encoder" in name or "decoder" in name), name


def short(judge: Path, dropout: float) -> Path:
    path = judge / f"short-{dropout:g}.yaml"
    path.write_text(SHORT.replace("DROPOUT", str(dropout)))
    return path


@pytest.mark.slow
def test_a_killed_training_ends_with_the_same_bytes(
    judge: Path, start: Callable[..., Any], tmp_path: Path
) -> None:
    """Killed in the movements and in the pairs."""
    recipe = short(judge, 0.2)
    runs = [tmp_path / name for name in ("whole", "killed")]
    for run in runs:
        shutil.copytree(judge / "run", run)
        shutil.rmtree(run / "stages/evaluator")
    run_recipe(recipe, runs[0], console=Console(quiet=True))
    folder = runs[1] / "stages/evaluator"
    for checkpoint in ("step=00000004.ckpt", "step=00000012.ckpt"):
        process = start("run", recipe, "--out", runs[1])
        end = time.monotonic() + 120
        while not (folder / "checkpoints" / checkpoint).is_file():
            assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
            time.sleep(0.001)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert not (folder / "artifact.json").exists(), "it was over before the kill"
    process = start("run", recipe, "--out", runs[1])
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0 and "resuming evaluator at step 12 of 16" in output, output
    found = [(run / "stages/evaluator/model.safetensors").read_bytes() for run in runs]
    assert found[0] == found[1]


@pytest.mark.slow
def test_two_processes_train_as_one(judge: Path, start: Callable[..., Any], tmp_path: Path) -> None:
    recipe = short(judge, 0.0)
    runs = [tmp_path / name for name in ("one", "two")]
    for run, devices in zip(runs, (1, 2), strict=True):
        shutil.copytree(judge / "run", run)
        shutil.rmtree(run / "stages/evaluator")
        process = start("run", recipe, "--out", run, "--set", f"hardware.devices={devices}")
        output, _ = process.communicate(timeout=150)
        assert process.returncode == 0, output
    weights = [load_file(run / "stages/evaluator/model.safetensors") for run in runs]
    assert weights[0].keys() == weights[1].keys()
    for name, value in weights[0].items():
        assert np.abs(value.astype(np.float64) - weights[1][name]).max() < 1e-4, name
    logged = [[row for row in metrics(run) if "val/matching_loss" in row] for run in runs]
    assert len(logged[0]) == len(logged[1]) == 2
    for first, second in zip(*logged, strict=True):
        for name in ("val/matching_loss", "val/movement_loss"):
            assert first[name] == pytest.approx(second[name], rel=1e-3)


@pytest.mark.slow
def test_an_evaluation_is_judged_by_it(judge: Path, call: Callable[..., Any], tmp_path: Path) -> None:
    (judge / "judged.yaml").write_text(JUDGED)
    shutil.copytree(judge / "run", tmp_path / "run")
    done = call("run", judge / "judged.yaml", "--out", tmp_path / "run", "--replace")
    assert done.code == 0, done.err
    figures = json.loads((tmp_path / "run/stages/evaluate/metrics.json").read_text())
    weights = sha256_of(tmp_path / "run/stages/evaluator/model.safetensors")
    assert figures["protocol"]["by_evaluator"] == {
        "stage": "evaluator", "kind": "evaluator", "sha256": weights,
    }  # fmt: skip
    assert "retrieval" not in figures and "distribution" not in figures, "no TMA, no figures by it"
    found = figures["by_evaluator"]
    data, evaluator = loaded(tmp_path / "run")
    assert found["matching"]["clips"] == 24 and found["matching"]["size"] == 8
    rows = found["distribution"]["rows"]
    assert 0 < rows["training"]["fid"]["mean"] < rows["mean_pose"]["fid"]["mean"]
    assert rows["generated"]["fid"]["mean"] > 0 and data.layout == evaluator.layout
    assert "R-Precision among 8 by the evaluator, 24 clips" in done.out
    retrieved = retrieve(tmp_path / "run", "evaluator")
    truths = [t for t in (truth_of(data.split("test"), i) for i in range(60)) if t.caption]
    judge_ = Judge.evaluator(evaluator)
    text, motion = judge_.texts(truths), judge_.recorded(truths)
    closest = torch.cdist(text.double(), motion.double()).argmin(1) == torch.arange(len(truths))
    assert retrieved.protocols[0].figures["t2m/R@1"] == pytest.approx(closest.double().mean().item())
    assert retrieved.facts["sha256"] == weights and retrieved.facts["clips"] == len(truths) == 60


@pytest.mark.slow
def test_other_layouts_and_words_are_refused(judge: Path) -> None:
    data, evaluator = loaded(judge / "run")
    evaluator.require_layout(data.layout, "evaluator")
    others = (
        (MotionLayout.named("wholebody313"), "the data are wholebody313 at 30 fps"),
        (MotionLayout.named("body133", fps=30), "the data are body133 at 30 fps"),
        (MotionLayout.named("body133", family="h3d"), r"the data are body133 at 20 fps \(family h3d\)"),
    )
    for layout, said in others:
        sentence = rf"evaluator 'judge' judges body133 at 20 fps \(family exact\), and {said}"
        with pytest.raises(UserError, match=sentence):
            evaluator.require_layout(layout, "judge")
    with pytest.raises(
        UserError, match=r"1 of the 1 captions to be judged are not here, such as 'nobody says'"
    ):
        evaluator.embed_captions(["nobody says"], [()])
    words = evaluator.words
    assert isinstance(words, StageWords)
    foreign = replace(evaluator, words=replace(words, encoder="other:123"))
    with pytest.raises(UserError, match=r"model\.json: this evaluator was trained on captions as other:123"):
        foreign.embed_captions(["a person walks"], [()])
    facts = load_facts(judge / "run/stages/evaluator")
    stats = replace(evaluator.stats, layout=MotionLayout.named("body133", fps=30))
    given = Given({"stats": lambda: stats, "text": lambda: words.text})
    with pytest.raises(
        UserError, match="trained on layout body133 at 20 fps and is given statistics of body133"
    ):
        EvaluatorStage().loaded(evaluator.net, facts, given)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"movement_steps": 10, "train": {"steps": 10}}, "movement_steps 10 leave none of train.steps 10"),
        ({"train": {"compile": True}}, "train.compile: torch cannot compile recurrent networks"),
        ({"train": {"batch_size": 1}}, "a batch of one clip has no mismatching pair"),
        ({"max_frames": 50}, "key 'max_frames' = 50"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        EvaluatorStageConfig.parse(settings, "recipe")


def test_defaults_are_the_published_ones() -> None:
    config = EvaluatorStageConfig()
    assert (config.optim.optimizer, config.optim.lr, config.optim.betas) == ("adam", 1e-4, (0.9, 0.999))
    assert (config.train.batch_size, config.loss.margin, config.max_frames) == (32, 10.0, 196)
