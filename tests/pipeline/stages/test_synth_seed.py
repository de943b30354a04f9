"""The seed of synthetic clips: the recipe's where the stage names none, and 0 where it names 0."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.schema import Manifest
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample
from motionloom.pipeline.contract.stage import Shelf, StageContext
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.data import SynthStageConfig, run_synth


@pytest.mark.parametrize(("given", "want"), [({}, 7), ({"seed": 0}, 0), ({"seed": 3}, 3)])
def test_zero_is_a_seed(given: dict[str, int], want: int, tmp_path: Path) -> None:
    config = SynthStageConfig.parse({"clips": 2, "test_fraction": 0.0, "val_fraction": 0.0} | given, "data")
    assert SynthStageConfig.parse(config.dump(), "the resolved recipe") == config
    console = Console(quiet=True)
    run_synth(StageContext("data", "made", config, tmp_path, {}, 7, Hardware(), console, Shelf()))
    manifest = Manifest.load_json(tmp_path / "shards/manifest.json")
    assert manifest.options["seed"] == want
    found = ShardDataset.open(tmp_path / "shards", "train")
    same = SynthConfig(clips=2, test_fraction=0.0, val_fraction=0.0, seed=want)
    for i in range(2):
        index = int(found.ids[i].rpartition("-")[2])
        np.testing.assert_array_equal(found.motion(i), make_sample(index, config=same).motion)
