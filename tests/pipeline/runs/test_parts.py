"""A recipe's conversion in parts: at once in one run folder, joined by a run without a part."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import pytest
from preempted import write_recipe
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.lock import file_lock
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.cluster.launch import launch_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import load_recipe


def convert(recipe: Path, run: Path, part: str = "", until: str = "data") -> None:
    sets = (f"hardware.part={part}",) if part else ()
    run_recipe(recipe, run, overrides=sets, select=Selection(until=until), console=Console(quiet=True))


def files(run: Path) -> dict[Path, bytes]:
    """All but times."""
    data = run / "stages/data"
    found = (path for path in data.rglob("*") if path.is_file() and path.name != "timing.json")
    return {path.relative_to(data): path.read_bytes() for path in found}


def test_parts_beside_each_other_equal_one_process(tmp_path: Path) -> None:
    recipe, run, whole = write_recipe(tmp_path, 5), tmp_path / "run", tmp_path / "whole"
    convert(recipe, whole)
    run.mkdir()
    (run / "stages/data/shards").mkdir(parents=True)
    (run / "stages/data/shards/old.tar").touch()  # of another plan: the first part clears it away, no other
    for part, left in (("2/2", ["1-1"]), ("1/2", []), ("2/2", [])):
        convert(recipe, run, part)
        said = Console(file=io.StringIO(), width=200)
        how: dict[str, Any] = {"out": run, "gpus_per_node": 0, "dry_run": True, "console": said}
        launch_recipe(recipe, options=("parts=2",), **how)
        assert re.findall("--array=(.*)", said.file.getvalue()) == left  # type: ignore[attr-defined]
        assert not (run / "stages/data/artifact.json").exists()
    with file_lock(run / ".locks/data", shared=True), pytest.raises(UserError, match="stage 'data'"):
        convert(recipe, run)
    with file_lock(run / ".locks/data", shared=True):
        convert(recipe, run, "1/2")
    convert(recipe, run)
    wanted = files(whole)
    assert files(run) == wanted and Path("shards/manifest.json") in wanted
    convert(recipe, run, "1/2")  # given once more: there is nothing to do
    assert files(run) == wanted
    assert load_recipe(run / "recipe.yaml").hardware.part is None
    with pytest.raises(UserError, match="stage 'stats' cannot be made in parts"):
        convert(recipe, run, "1/2", until="stats")
