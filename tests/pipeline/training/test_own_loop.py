"""`docs/train_h2vq.py`, the loop to copy: it learns, and goes on from a kill with the same bytes."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.models import H2VQConfig

SCRIPT = Path(__file__).parents[3] / "docs" / "train_h2vq.py"


def test_the_loop_of_the_documents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synthesize(SynthConfig(clips=40), tmp_path / "shards", progress=False)

    def train(out: str, **changes: Any) -> None:
        words = [tmp_path / "shards", tmp_path / out, "--steps", 60, "--batch", 8, "--device", "cpu"]
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, words)])
        main = runpy.run_path(str(SCRIPT))["main"]
        net = H2VQConfig(width=24, depth=1, code_dim=24, num_codes=32)
        main.__globals__.update(NET=net, SAVE_EVERY=16, VALIDATE_EVERY=24, **changes)
        main()

    def die(*_: object) -> float:
        raise KeyboardInterrupt

    train("whole")
    with pytest.raises(KeyboardInterrupt):
        train("killed", validate=die)  # at step 24; step 16 is saved
    assert not (tmp_path / "killed/model.safetensors").exists()
    train("killed")
    for name in ("model.safetensors", "log.jsonl", "stats.safetensors"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()
    rows = [json.loads(line) for line in (tmp_path / "whole/log.jsonl").read_text().splitlines()]
    assert rows[-2]["loss"] < rows[0]["loss"] and 0 < rows[-1]["val_mpjpe_mm"] < 1000
