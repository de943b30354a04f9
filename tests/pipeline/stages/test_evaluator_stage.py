"""The trained evaluator: it learns, goes on after a kill, trains on two processes, judges, and refuses."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.figures import CHANCE, MODEL, RECORDED, STILL, TRAINING, FigureFile
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.latent_metrics import judged_figures
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.stages.networks.evaluator import EvaluatorStage, EvaluatorStageConfig
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
    stages, stage_cache = finished_stages(run), StageCache()
    return stage_cache.get(stages["data"]), stage_cache.get(stages["evaluator"])


@pytest.mark.slow
def test_it_finds_the_motion_of_a_caption(judge: Path) -> None:
    """Of 32 clips never trained on. A guess is right in 9 % of cases within three."""
    data, evaluator = loaded(judge / "run")
    test = data.split("test")
    truths = [truth_of(test, i) for i in range(len(test))]
    latents = Judge(evaluator).latents(truths, [], truths[:8], {})
    both = replace(latents, made=[latents.real])
    words = [truth.caption for truth in truths]
    figures = judged_figures("evaluator", "it", both, words, {}, size=32, among=2, seed=0)
    found = {(one.name.removeprefix("evaluator."), one.row): one.value for one in figures}
    assert found["top-3", CHANCE] == pytest.approx(3 / 32)
    assert found["top-3", RECORDED] > 0.6, found
    assert found["top-3", STILL] < 0.25
    assert found["matching_score", RECORDED] < 0.5 * found["matching_score", STILL]


@pytest.mark.slow
def test_an_evaluation_is_judged_by_it(judge: Path, call: Callable[..., Any], tmp_path: Path) -> None:
    (judge / "judged.yaml").write_text(JUDGED)
    shutil.copytree(judge / "run", tmp_path / "run")
    done = call("run", judge / "judged.yaml", "--out", tmp_path / "run", "--replace")
    assert done.code == 0, done.err
    file = FigureFile.read(tmp_path / "run/stages/evaluate/metrics.json")
    weights = sha256_of(tmp_path / "run/stages/evaluator/model.safetensors")
    assert file.about["judges"] == {
        "evaluator": {"stage": "evaluator", "kind": "evaluator", "sha256": weights}
    }
    assert not any(one.name.startswith("tma.") for one in file.figures), "no TMA, no figures by it"
    top = file.of("evaluator.top-1")
    data, evaluator = loaded(tmp_path / "run")
    assert top is not None and top.protocol["judge"] == weights
    assert (top.protocol["clips"], top.protocol["candidates"]) == (24, 8)
    others, still, made = (file.of("evaluator.fid", row) for row in (TRAINING, STILL, MODEL))
    assert others is not None and still is not None and made is not None
    assert 0 < others.value < still.value and made.value > 0 and data.layout == evaluator.layout
    assert "R-Precision by the evaluator" in done.out
    retrieved = retrieve(tmp_path / "run", "evaluator")
    truths = [t for t in (truth_of(data.split("test"), i) for i in range(60)) if t.caption]
    judge_ = Judge(evaluator)
    text, motion = judge_.texts(truths), judge_.recorded(truths)
    closest = torch.cdist(text.double(), motion.double()).argmin(1) == torch.arange(len(truths))
    first = retrieved.of("A.t2m/R@1")
    assert first is not None and first.value == pytest.approx(closest.double().mean().item())
    assert retrieved.about["sha256"] == weights and retrieved.about["clips"] == len(truths) == 60


@pytest.mark.slow
def test_other_layouts_and_words_are_refused(judge: Path) -> None:
    data, evaluator = loaded(judge / "run")
    evaluator.require_layout(data.layout, "evaluator")
    words = evaluator.words
    assert isinstance(words, StageWords)
    foreign = replace(evaluator, words=replace(words, encoder="other:123"))
    stats = replace(evaluator.stats, layout=MotionLayout.named("body133", fps=30))
    given = EvaluatorStage.inputs({"stats": lambda: stats, "text": lambda: words.text})
    facts = load_facts(judge / "run/stages/evaluator")
    for refused, said in (
        (lambda: evaluator.require_layout(MotionLayout.named("wholebody313"), "judge"), "wholebody313"),
        (lambda: evaluator.require_layout(stats.layout, "judge"), "30 fps"),
        (lambda: evaluator.embed_captions(["nobody says"], [()]), "'nobody says'"),
        (lambda: foreign.embed_captions(["a person walks"], [()]), r"model\.json: .*other:123"),
        (lambda: EvaluatorStage().loaded(evaluator.net, facts, given), "statistics of body133"),
    ):
        with pytest.raises(UserError, match=said):
            refused()


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
