"""The trained evaluator: it judges, and refuses."""

from __future__ import annotations

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
from motionloom.pipeline.evaluation.figures import MODEL, STILL, TRAINING, FigureFile
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.stages.networks.evaluator import EvaluatorStage
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
    movement_steps: 2
    train: {steps: 4, batch_size: 32, checkpoint_every: 60, validate_every: 0}
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
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run."""
    root = tmp_path_factory.mktemp("judge")
    (root / "judge.yaml").write_text(RECIPE)
    return run_recipe(root / "judge.yaml", root / "run", console=Console(quiet=True))


def loaded(run: Path) -> tuple[Any, LoadedEvaluator]:
    """Data and evaluator of a run."""
    stages, stage_cache = finished_stages(run), StageCache()
    return stage_cache.get(stages["data"]), stage_cache.get(stages["evaluator"])


@pytest.mark.slow
def test_an_evaluation_is_judged_by_it(run: Path) -> None:
    file = FigureFile.read(run / "stages/evaluate/metrics.json")
    weights = sha256_of(run / "stages/evaluator/model.safetensors")
    assert file.about["judges"] == {
        "evaluator": {"stage": "evaluator", "kind": "evaluator", "sha256": weights}
    }
    assert not any(one.name.startswith("tma.") for one in file.figures), "no TMA, no figures by it"
    top = file.of("evaluator.top-1")
    data, evaluator = loaded(run)
    assert top is not None and top.protocol["judge"] == weights
    assert (top.protocol["clips"], top.protocol["candidates"]) == (24, 8)
    others, still, made = (file.of("evaluator.fid", row) for row in (TRAINING, STILL, MODEL))
    assert others is not None and still is not None and made is not None
    assert 0 < others.value < still.value and made.value > 0 and data.layout == evaluator.layout
    retrieved = retrieve(run, "evaluator")
    truths = [t for t in (truth_of(data.split("test"), i) for i in range(60)) if t.caption]
    judge_ = Judge(evaluator)
    text, motion = judge_.texts(truths), judge_.recorded(truths)
    closest = torch.cdist(text.double(), motion.double()).argmin(1) == torch.arange(len(truths))
    first = retrieved.of("A.t2m/R@1")
    assert first is not None and first.value == pytest.approx(closest.double().mean().item())
    assert retrieved.about["sha256"] == weights and retrieved.about["clips"] == len(truths) == 60


@pytest.mark.slow
def test_other_layouts_and_words_are_refused(run: Path) -> None:
    data, evaluator = loaded(run)
    evaluator.require_layout(data.layout, "evaluator")
    words = evaluator.words
    assert isinstance(words, StageWords)
    foreign = replace(evaluator, words=replace(words, encoder="other:123"))
    stats = replace(evaluator.stats, layout=MotionLayout.named("body133", fps=30))
    given = EvaluatorStage.inputs({"stats": lambda: stats, "text": lambda: words.text})
    facts = load_facts(run / "stages/evaluator")
    for refused, said in (
        (lambda: evaluator.require_layout(MotionLayout.named("wholebody313"), "judge"), "wholebody313"),
        (lambda: evaluator.require_layout(stats.layout, "judge"), "30 fps"),
        (lambda: evaluator.embed_captions(["nobody says"], [()]), "'nobody says'"),
        (lambda: foreign.embed_captions(["a person walks"], [()]), r"model\.json: .*other:123"),
        (lambda: EvaluatorStage().loaded(evaluator.net, facts, given), "statistics of body133"),
    ):
        with pytest.raises(UserError, match=said):
            refused()
