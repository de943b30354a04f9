"""A new model is its folder in `models/` and one file in `stages/networks/`: nothing names either."""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path

import pytest

from motionloom.pipeline.contract import stage
from motionloom.pipeline.stages import networks

PACER = Path(__file__).resolve().parents[2] / "helpers/pacer_stage.py"


def test_a_file_beside_the_others_is_a_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "_KINDS", dict(stage.stage_kinds()))
    shutil.copy(PACER, tmp_path / "pacer.py")
    monkeypatch.setattr(networks, "__path__", [*networks.__path__, str(tmp_path)])
    runpy.run_module("motionloom.pipeline.stages.table")
    made = sys.modules.pop("motionloom.pipeline.stages.networks.pacer")
    assert type(stage.stage_kind("pacer", "here")).__module__ == made.__name__
