"""Run folders from strangers, and damaged ones: nothing is written outside them, and damage is named."""

from __future__ import annotations

import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_bytes
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import FunctionStage, StageCache, StageConfig, StageContext
from motionloom.pipeline.runs.api import evaluate_run, run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.store.artifact import require_unchanged
from motionloom.pipeline.store.files import open_own, write_json

TOY = "name: toy\nhardware: {accelerator: cpu}\nstages: {data: {kind: root}, figures: {kind: sum}}"


def write_value(context: StageContext) -> None:
    write_json(context.folder / "value.json", 1)


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A finished run of two stages."""
    root = FunctionStage("root", "a toy", StageConfig, write_value, offers=frozenset({"data"}))
    last = FunctionStage("sum", "a toy", StageConfig, write_value, ("data",), offers=frozenset({"figures"}))
    register_toys(monkeypatch, root, last)
    (tmp_path / "toy.yaml").write_text(TOY)
    return run_recipe(tmp_path / "toy.yaml", tmp_path / "run", console=Console(quiet=True))


@pytest.mark.parametrize(
    "place", [".lock", "stages/data", "stages/figures/checkpoints", "evaluate", "stages/data/value.json"]
)
def test_a_run_with_a_link_out_of_it_is_refused(place: str, toy: Path) -> None:
    """Whatever command would write there; what the link names stays as it is."""
    inside, outside = toy / place, toy.parent / "outside"
    if inside.is_dir():
        inside.rename(outside)
    else:
        outside.write_text("mine")
        inside.unlink(missing_ok=True)
    inside.symlink_to(outside)
    before = {path: path.stat().st_mtime_ns for path in (outside, *outside.rglob("*"))}
    quiet = Console(quiet=True)
    for write in (
        lambda: run_recipe(toy / "recipe.yaml", toy, select=Selection(first="data"), console=quiet),
        lambda: evaluate_run(toy, console=quiet),
    ):
        with pytest.raises(UserError, match=f"{re.escape(str(inside))}: is a link out"):
            write()
    assert before == {path: path.stat().st_mtime_ns for path in (outside, *outside.rglob("*"))}


def test_links_are_not_followed_and_pipes_are_refused(toy: Path) -> None:
    (toy / "log").symlink_to(toy / "recipe.yaml")
    with pytest.raises(OSError, match="symbolic links"), open_own(toy / "log", "a"):
        pass
    os.mkfifo(toy / "stages/data/metrics.jsonl")
    with pytest.raises(UserError, match=r"metrics\.jsonl: "):
        evaluate_run(toy, console=Console(quiet=True))


def test_what_is_no_plain_file_is_written_into(tmp_path: Path) -> None:
    """A device or a pipe would be replaced by a file otherwise."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_bytes)
        write_bytes(pipe, b"content")
        assert read.result(30) == b"content"
    assert pipe.is_fifo() and len(list(tmp_path.iterdir())) == 1
    written = tmp_path / "written"
    with written.open("wb") as file:
        (tmp_path / "stdout").symlink_to(f"/proc/self/fd/{file.fileno()}")
        write_bytes(tmp_path / "stdout", b"content")
    assert (tmp_path / "stdout").is_symlink() and written.read_bytes() == b"content"


def test_a_finished_stage_that_was_damaged_is_named_when_it_is_opened(toy: Path) -> None:
    """Compared once as long as size and times stay; a time that is set back changes nothing."""
    path = toy / "stages/data/value.json"
    assert require_unchanged(path.parent) == 1 and require_unchanged(path.parent) == 0
    before = path.stat()
    path.write_bytes(bytes([path.read_bytes()[0] ^ 1, *path.read_bytes()[1:]]))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    damage = f"{re.escape(str(path))}: is not the file that its stage made.*--from data"
    with pytest.raises(UserError, match=damage):
        StageCache().get(finished_stages(toy)["data"])
    with pytest.raises(UserError, match=damage):
        run_recipe(toy / "recipe.yaml", toy, verify=True, console=Console(quiet=True))
    path.unlink()
    with pytest.raises(UserError, match=r"value\.json: is gone"):
        require_unchanged(path.parent)
