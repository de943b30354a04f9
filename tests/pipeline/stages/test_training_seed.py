"""The seed of one training: the recipe's where the stage names none, and its own otherwise."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from motionloom.pipeline.runs.api import run_recipe

RECIPE = """
name: seeds
seed: 7
stages:
  data: {kind: synth, clips: 12, layout: body133, min_seconds: 2.0, max_seconds: 5.0, seed: 1}
  stats: {kind: stats}
  tokenizer: &small
    kind: mq
    net: {part: all, width: 8, depth: 0, code_dim: 4, num_codes: 8, quantizer: ema}
    train: {steps: 3, batch_size: 8, checkpoint_every: 3, validate_every: 0}
  same: *small
  other: *small
"""


def test_trainings_of_one_recipe_differ_by_their_seed_alone(tmp_path: Path) -> None:
    path = tmp_path / "seeds.yaml"
    path.write_text(RECIPE, encoding="utf-8")
    console = Console(quiet=True)
    folder = run_recipe(
        path, tmp_path / "run", overrides=["same.train.seed=7", "other.train.seed=8"], console=console
    )
    found = {
        name: next((folder / "stages" / name).glob("*.safetensors")).read_bytes()
        for name in ("tokenizer", "same", "other")
    }
    assert found["tokenizer"] == found["same"] != found["other"]
