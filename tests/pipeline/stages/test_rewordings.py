"""The stage of rewordings: TMA takes it where a recipe has it, and a finished model does without."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.stages.data import rewordings

RECIPE = """
name: reworded
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
defaults:
  tma:
    net: {latent: 8, ff: 16, layers: 1, heads: 2, frame_stride: 8, text_noise: 0.5, text_dropout: 0.2}
    train: {steps: 2, batch_size: 4, validate_every: 0}
stages:
  data: {kind: synth, clips: 24}
  stats: {kind: stats}
  text: {kind: text}
  plain: {kind: tma}
  rewordings: {kind: rewordings, share: 1.0, nearness: 0.3}
  tma: {kind: tma}
"""


@pytest.fixture(autouse=True)
def _few_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real encoder, but not its 20,000 words."""
    monkeypatch.setattr(
        rewordings, "whole_words", lambda _: ["stroll", "strolled", "somebody", "foot", "fist"]
    )


def test_tma_learns_from_rewordings_of_the_training_captions(tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    # `plain` stands for a recipe without the stage: its role is left empty.
    recipe.write_text(RECIPE.replace("plain: {kind: tma}", "plain: {kind: tma, inputs: {rewordings: null}}"))
    run = tmp_path / "run"
    run_recipe(recipe, run, console=Console(quiet=True))
    stages, stage_cache = finished_stages(run), StageCache()
    made = stage_cache.get(stages["rewordings"])
    data = stage_cache.get(stages["data"]).split("train")
    captions = {c.text for i in range(len(data)) for c in data.texts(i)}
    said = json.loads((run / "stages/rewordings/rewordings.json").read_text())["captions"]
    assert captions <= set(said) and all(len(others) == 2 for others in said.values())
    assert sum(caption not in others for caption, others in said.items()) > len(said) / 4
    assert made.cache.encoder == stage_cache.get(stages["text"]).cache.encoder
    inputs = json.loads((run / "stages/tma/artifact.json").read_text())["inputs"]
    assert inputs["rewordings"]["stage"] == "rewordings"
    weights = [(run / "stages" / name / "model.safetensors").read_bytes() for name in ("plain", "tma")]
    assert weights[0] != weights[1]


def test_an_encoder_without_words_is_refused(tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        RECIPE.replace("  plain: {kind: tma}\n", "").replace(
            "rewordings: {kind: rewordings,",
            "aligned: {kind: aligned_text}\n  second: {kind: rewordings, inputs: {text: aligned},",
        )
    )
    with pytest.raises(UserError, match="rewordings need an encoder of words"):
        run_recipe(recipe, tmp_path / "run", console=Console(quiet=True))
