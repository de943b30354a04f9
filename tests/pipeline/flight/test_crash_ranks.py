"""Two processes, of which the second meets a batch that is not finite: both stop, and the replay does too."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from toy_training import RECIPE

from motionloom.pipeline.contract.registry import VARIABLE
from motionloom.pipeline.store.flight_log import read_flight

pytestmark = pytest.mark.slow
HELPERS = Path(__file__).resolve().parents[2] / "helpers"


def test_both_stop_and_the_replay_is_the_same_to_the_bit(
    start: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "toy_training_stage")
    path = os.pathsep.join(filter(None, (str(HELPERS), os.environ.get("PYTHONPATH"))))
    monkeypatch.setenv("PYTHONPATH", path)
    recipe, run = tmp_path / "toys.yaml", tmp_path / "run"
    recipe.write_text(RECIPE.replace("devices: 1", "devices: 2"))
    sets = ("--set", "toy.fails_at=13", "--set", "toy.fails_on_rank=1")
    process = start("run", recipe, "-o", run, *sets)
    said, _ = process.communicate(timeout=200)
    bundle = run / "stages/toy/crash/step_00000014_rank_1"
    assert process.returncode == 2, said
    assert "in step 14 on rank 1 the loss is not finite (recon = nan, loss = nan" in said
    assert [path.name for path in bundle.parent.iterdir()] == [bundle.name]
    record = json.loads((bundle / "crash.json").read_text())
    assert (record["rank"], record["world"], record["checkpoint"]["step"]) == (1, 2, 10)
    assert [one["first"] for one in record["steps"][-1]["samples"]] == [4, 5, 6, 7]
    rows = read_flight(run / "stages/toy")
    assert rows.keys() == {0, 1} and rows[0][0]["grad_norm"] == rows[1][0]["grad_norm"]
    process = start("replay", bundle)
    said, _ = process.communicate(timeout=200)
    assert process.returncode == 1, said
    assert "its batch is the same as in the bundle" in said
    assert "the failure came again, with the same figures to the bit" in said
