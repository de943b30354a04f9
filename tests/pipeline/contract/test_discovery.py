"""A new baseline is its folder; a file of one's own is named by a variable: nothing else names them."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from motionloom.datasets.base import register
from motionloom.pipeline import baselines
from motionloom.pipeline.contract import stage
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.store.artifact import Artifact

COUNT = """
from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, StageContext, register


def count(context: StageContext) -> None:
    clips = len(context.given["data"].split("train"))
    (context.folder / "clips.txt").write_text(f"{clips} training clips")


register(FunctionStage("count", "counts clips", StageConfig, count, takes=("data",)))
"""


@pytest.fixture(autouse=True)
def kinds_are_put_back() -> Iterator[None]:
    before = dict(stage.stage_kinds())
    yield
    for name in stage.KINDS.keys() - before.keys():
        del stage.KINDS[name]
    register.discover.cache_clear()


def test_a_folder_beside_the_baselines_is_a_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "swing").mkdir()
    (tmp_path / "swing/__init__.py").touch()
    (tmp_path / "swing/stage.py").write_text(
        "from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, register\n"
        "register(FunctionStage('swing', 'a toy', StageConfig, print))"
    )
    monkeypatch.setattr(baselines, "__path__", [*baselines.__path__, str(tmp_path)])
    runpy.run_module("motionloom.pipeline.stages.table")
    assert sys.modules.pop("motionloom.pipeline.baselines.swing.stage")
    assert stage.stage_kind("swing", "here").summary == "a toy"


def test_a_stage_of_one_file_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "count_clips.py").write_text(COUNT)
    register.discover.cache_clear()
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("MOTIONLOOM_STAGES", str(tmp_path / "count_clips.py"))
    (tmp_path / "mine.yaml").write_text(
        "name: mine\nstages: {data: {kind: synth, clips: 4, layout: body133, val_fraction: 0, "
        "test_fraction: 0}, clips: {kind: count}}"
    )
    run = run_recipe(tmp_path / "mine.yaml", tmp_path / "run", console=Console(quiet=True))
    assert (run / "stages/clips/clips.txt").read_text() == "4 training clips"
    made = {name: Artifact.load_json(run / f"stages/{name}/artifact.json").code for name in ("data", "clips")}
    assert not made["data"] and list(made["clips"]) == ["count_clips"]
