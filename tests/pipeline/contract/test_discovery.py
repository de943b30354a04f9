"""Kinds are declared by name and imported when used; a file of one's own is named by a variable."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from motionloom.datasets.base import register
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.cli.main import app
from motionloom.pipeline.contract import stage
from motionloom.pipeline.contract.command import COMMANDS
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
def kinds_are_put_back(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    stage.stage_kinds()
    declared = register._declared("stage kind")
    monkeypatch.setattr(declared, "places", dict(declared.places))
    monkeypatch.setattr(stage.KINDS, "_things", dict(stage.KINDS._things))
    yield
    register.discover.cache_clear()
    sys.modules.pop("swing", None)


def test_a_declared_kind_is_imported_when_it_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "swing.py").write_text(
        "from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, register\n"
        "register(FunctionStage('swing', 'a toy', StageConfig, print))"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    register.declare("stage kind", {"swing": "swing", "hop": "swing", "gone": "no_such_module"})
    assert "swing" in stage.stage_kinds() and "swing" not in sys.modules
    assert stage.stage_kind("swing", "here").summary == "a toy"
    with pytest.raises(UserError, match="swing: registers no stage kind 'hop'"):
        stage.stage_kind("hop", "here")
    with pytest.raises(UserError, match="no_such_module"):
        stage.stage_kind("gone", "here")
    with pytest.raises(UserError, match="'swing'"):
        register.declare("stage kind", {"swing": "other"})
    with pytest.raises(UserError, match="another one"):
        register.register(stage.FunctionStage("mdm", "a stranger", stage.StageConfig, print))


@pytest.mark.parametrize("words", [["hop"], ["data", "hop"]])
def test_a_declared_command_is_imported_when_it_is_asked_for(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "swing.py").write_text(
        "from motionloom.datasets.base.register import register\n"
        "from motionloom.pipeline.contract.command import Command\n"
        "def hop(times: int):\n    print('hop ' * times)\n"
        f"register(Command('{' '.join(words)}', hop))"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(COMMANDS, "_things", {})
    monkeypatch.setitem(register._DECLARED, "command", register._Declared({" ".join(words): "swing"}))
    run = CliRunner().invoke
    assert "hop" not in run(app, ["info", "--help"]).output and "swing" not in sys.modules
    assert run(app, [*words, "2"]).output == "hop hop \n"
    assert "hop" in run(app, [*words[:-1], "--help"]).output
    register.declare("command", {"data join": "swing"})
    with pytest.raises(UserError, match="'data join': motionloom has one"):
        run(app, ["data", "--help"], catch_exceptions=False)


def test_what_was_taken_out_of_the_installation_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        EntryPoint(name, f"motionloom.pipeline.{name}.table", register.GROUP) for name in ("stages", "gone")
    ]
    monkeypatch.setattr(register, "entry_points", lambda group: points)
    register.discover.cache_clear()
    register.discover()
    points.append(EntryPoint("x", "motionloom.pipeline.stages.gone", register.GROUP))
    register.discover.cache_clear()
    with pytest.raises(UserError, match="cannot be imported"):
        register.discover()


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
