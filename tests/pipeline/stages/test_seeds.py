"""Seeds: the recipe's where a stage names none, and its own otherwise; 0 is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.schema import Manifest
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample
from motionloom.pipeline.contract.stage import StageCache, StageContext, stage_kind
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.stages.data.data import SynthStageConfig, run_synth

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


@pytest.mark.parametrize(("given", "want"), [({}, 7), ({"seed": 0}, 0), ({"seed": 3}, 3)])
def test_zero_is_a_seed(given: dict[str, int], want: int, tmp_path: Path) -> None:
    config = SynthStageConfig.parse({"clips": 2, "test_fraction": 0.0, "val_fraction": 0.0} | given, "data")
    assert SynthStageConfig.parse(config.dump(), "the resolved recipe") == config
    console = Console(quiet=True)
    run_synth(StageContext("data", "made", config, tmp_path, {}, 7, Hardware(), console, StageCache()))
    manifest = Manifest.load_json(tmp_path / "shards/manifest.json")
    assert manifest.options["seed"] == want
    found = ShardDataset.open(tmp_path / "shards", "train")
    same = SynthConfig(clips=2, test_fraction=0.0, val_fraction=0.0, seed=want)
    for i in range(2):
        index = int(found.ids[i].rpartition("-")[2])
        np.testing.assert_array_equal(found.motion(i), make_sample(index, config=same).motion)


def test_dances_to_rhythm_are_made_again_for_another_tracker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "beats.safetensors"
    other.write_bytes(b"another tracker")
    kind = stage_kind("synth", "data")

    def facts(columns: str) -> object:
        dances = {"dances": {"songs": 2, "columns": columns}, "min_seconds": 4.0}
        return kind.external(SynthStageConfig.parse(dances, "data"))

    before = [facts(columns) for columns in ("public", "rhythm")]
    monkeypatch.setattr("motionloom.pipeline.stages.data.data.WEIGHTS", other)
    after = [facts(columns) for columns in ("public", "rhythm")]
    assert before[0] == after[0] == {} and before[1] != after[1]
