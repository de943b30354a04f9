"""The stage graph: skip, re-run, resume, select; on stages that only write a number."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import Field
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.fingerprint import RUNTIME
from motionloom.pipeline.contract.stage import Every, FunctionStage, StageConfig, StageContext
from motionloom.pipeline.runs.graph import Selection, execute, make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.files import write_json

NUMBER = frozenset({"number"})


class AddConfig(StageConfig):
    add: int = 1
    workers: int = Field(1, json_schema_extra=RUNTIME)


def run_add(context: StageContext) -> None:
    above = [json.loads((above.folder / "value.json").read_text()) for above in context.inputs.values()]
    write_json(context.folder / "value.json", sum(above) + context.config.add)


@pytest.fixture(autouse=True)
def toy_kinds(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    register_toys(
        monkeypatch,
        FunctionStage("root", "a number", AddConfig, run_add, given_names=NUMBER),
        FunctionStage(
            "sum", "a sum", AddConfig, run_add, ("left: number", "right?: number"), given_names=NUMBER
        ),
        FunctionStage("all", "a sum", AddConfig, run_add, (Every("numbers", "number"),)),
    )
    yield


def recipe(tmp_path: Path, *overrides: str) -> Recipe:
    path = tmp_path / "toy.yaml"
    path.write_text(
        "name: toy\nstages:\n"
        "  left: {kind: root, add: 1}\n"
        "  right: {kind: root, add: 10}\n"
        "  both: {kind: sum}\n"
        "  one: {kind: sum, inputs: {left: right, right: right}}\n"
        "  top: {kind: sum, inputs: {left: both}, add: 100}\n"
    )
    return load_recipe(path, overrides)


def go(tmp_path: Path, *overrides: str, select: Selection | None = None) -> list[str]:
    loaded = recipe(tmp_path, *overrides)
    run = tmp_path / "run"
    return execute(loaded, run, make_plan(loaded, run, select), Console(quiet=True))


def value(tmp_path: Path, stage: str) -> int:
    return int((tmp_path / "run/stages" / stage / "value.json").read_text())


def test_runs_all_then_nothing(tmp_path: Path) -> None:
    assert go(tmp_path) == ["left", "right", "both", "one", "top"]
    assert value(tmp_path, "top") == 122
    assert go(tmp_path) == []


def test_a_change_runs_that_stage_and_those_below(tmp_path: Path) -> None:
    go(tmp_path)
    assert go(tmp_path, "left.add=2") == ["left", "both", "top"]
    assert value(tmp_path, "top") == 123
    assert go(tmp_path, "left.add=2", "top.add=0") == ["top"]


def test_runtime_fields_change_nothing(tmp_path: Path) -> None:
    go(tmp_path)
    assert go(tmp_path, "left.workers=7", "hardware.workers=3") == []


def test_seed_changes_everything(tmp_path: Path) -> None:
    go(tmp_path)
    assert go(tmp_path, "seed=5") == ["left", "right", "both", "one", "top"]


def test_reason_names_the_field(tmp_path: Path) -> None:
    go(tmp_path)
    loaded = recipe(tmp_path, "left.add=2")
    reasons = {row.stage.name: row.reason for row in make_plan(loaded, tmp_path / "run")}
    assert reasons["left"] == "changed: add 1 -> 2"
    assert reasons["both"] == "input left changed"
    assert reasons["right"] == "finished"


def test_lost_output_runs_again(tmp_path: Path) -> None:
    go(tmp_path)
    (tmp_path / "run/stages/both/value.json").unlink()
    assert go(tmp_path) == ["both"]


def test_new_version_of_a_kind_runs_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go(tmp_path)
    register_toys(
        monkeypatch,
        FunctionStage(
            "sum",
            "a sum",
            AddConfig,
            run_add,
            ("left: number", "right?: number"),
            version=2,
            given_names=NUMBER,
        ),
    )
    assert go(tmp_path) == ["both", "one", "top"]


def test_selection(tmp_path: Path) -> None:
    assert go(tmp_path, select=Selection(until="both")) == ["left", "right", "both"]
    with pytest.raises(UserError, match="did you mean 'both'"):
        go(tmp_path, select=Selection(until="bot"))
    assert go(tmp_path, select=Selection(until="left, one")) == ["one"]
    with pytest.raises(UserError, match="did you mean 'one'"):
        go(tmp_path, select=Selection(until="left,ones"))
    go(tmp_path)
    assert go(tmp_path, select=Selection(first="both")) == ["both", "top"]
    assert go(tmp_path, select=Selection(only="one", force=True)) == ["one"]
    with pytest.raises(UserError, match="is not finished"):
        go(tmp_path, "right.add=4", select=Selection(only="top"))


SEVERAL = """
name: several
stages:
  every: {kind: all}
  first: {kind: root}
  second: {kind: root, add: 2}
  listed: {kind: all, inputs: {numbers: [second, first]}}
  one: {kind: all, inputs: {numbers: second}}
"""


def several(tmp_path: Path, *overrides: str) -> Recipe:
    path = tmp_path / "several.yaml"
    path.write_text(SEVERAL)
    return load_recipe(path, overrides)


def test_a_role_is_filled_by_every_stage_that_gives_it(tmp_path: Path) -> None:
    loaded, run = several(tmp_path), tmp_path / "run"
    filled = {stage.name: list(stage.inputs.values()) for stage in loaded.stages}
    assert filled["every"] == ["first", "second"]
    assert filled["listed"] == ["second", "first"] and filled["one"] == ["second"]
    execute(loaded, run, make_plan(loaded, run), Console(quiet=True))
    assert [value(tmp_path, name) for name in ("every", "listed", "one")] == [4, 4, 3]
    again = load_recipe(run / "recipe.yaml")
    assert again == loaded, "the resolved recipe is the recipe"
    assert [s.inputs for s in again.stages] == [s.inputs for s in loaded.stages]
    assert {row.action for row in make_plan(again, run)} == {"skip"}


def test_the_order_of_a_list_counts(tmp_path: Path) -> None:
    """The first of several generators is the default, so another order makes something else."""
    loaded, run = several(tmp_path), tmp_path / "run"
    execute(loaded, run, make_plan(loaded, run), Console(quiet=True))
    turned = several(tmp_path, "listed.inputs.numbers=[first, second]")
    rows = {row.stage.name: (row.action, row.reason) for row in make_plan(turned, run)}
    assert rows.pop("listed") == ("run", "seed, source files or the order of inputs changed")
    assert {action for action, _ in rows.values()} == {"skip"}


@pytest.mark.parametrize(
    ("override", "says"),
    [
        (
            "listed.inputs.numbers=[frst]",
            "numbers: 'frst' is no stage that gives a number; did you mean 'first'",
        ),
        ("listed.inputs.numbers=[every]", "'every' is no stage that gives a number"),
        ("listed.inputs.numbers=7", r"numbers must list stages, like \[gpt\]"),
        ("listed.inputs.number=[first]", "unknown role 'number'; did you mean 'numbers'"),
    ],
)
def test_a_list_of_what_does_not_fit_is_refused(override: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        several(tmp_path, override)


def test_artifact_lists_outputs_and_inputs(tmp_path: Path) -> None:
    go(tmp_path)
    artifact = Artifact.find(tmp_path / "run/stages/both")
    assert artifact is not None
    assert set(artifact.outputs) == {"value.json"}
    assert {role: i.stage for role, i in artifact.inputs.items()} == {"left": "left", "right": "right"}


def test_atomic_leaves_nothing_on_error(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "file") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_two_processes_do_not_share_a_run(tmp_path: Path) -> None:
    holder = subprocess.Popen(
        [
            sys.executable,
            "-P",
            "-c",
            "import fcntl, sys, time; file = open(sys.argv[1], 'w'); fcntl.flock(file, 2);"
            "print('held', flush=True); time.sleep(60)",
            str(lock_file(tmp_path)),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(UserError, match="another motionloom process"):
            go(tmp_path)
    finally:
        os.kill(holder.pid, signal.SIGKILL)
        holder.wait()
    assert go(tmp_path) == ["left", "right", "both", "one", "top"]


def lock_file(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    return tmp_path / "run/.lock"


def test_a_seed_of_the_data_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `data_seed` another `seed` keeps all that comes before the first training, byte for byte."""

    def draw(context: StageContext) -> None:
        write_json(context.folder / "value.json", context.seed)

    takes = ("left: number", "right?: number")
    register_toys(
        monkeypatch,
        FunctionStage("root", "a seed", AddConfig, draw, given_names=NUMBER),
        FunctionStage("sum", "a seed", AddConfig, draw, takes, given_names=NUMBER),
        FunctionStage("fit", "a seed", AddConfig, draw, takes, trains=True, given_names=NUMBER),
    )
    assert go(tmp_path, "both.kind=fit", "data_seed=3", "seed=5") == ["left", "right", "both", "one", "top"]
    seeds = {name: value(tmp_path, name) for name in ("left", "right", "one", "both", "top")}
    assert seeds == {"left": 3, "right": 3, "one": 3, "both": 5, "top": 5}, "top is made from a training"
    assert go(tmp_path, "both.kind=fit", "data_seed=3", "seed=6") == ["both", "top"]
    assert go(tmp_path, "both.kind=fit", "data_seed=6", "seed=6") == ["left", "right", "both", "one", "top"]
    assert go(tmp_path, "both.kind=fit", "seed=6") == [], "it is `seed` where it is not given"
    again = load_recipe(tmp_path / "run/recipe.yaml")
    assert again.data_seed is None and "data_seed" not in again.to_yaml()
    seeded = recipe(tmp_path, "data_seed=3")
    (tmp_path / "seeded.yaml").write_text(seeded.to_yaml())
    assert load_recipe(tmp_path / "seeded.yaml") == seeded
    with pytest.raises(UserError, match="data_seed"):
        recipe(tmp_path, "data_seed=-1")


@pytest.mark.parametrize(
    ("select", "says"),
    [
        (Selection(first="lefft"), "--from lefft: recipe toy has no stage 'lefft'; did you mean 'left'"),
        (Selection(until="bot"), "--until bot: .* did you mean 'both'"),
        (Selection(only="x"), "--only x: .* valid names: left, right, both, one, top"),
    ],
)
def test_a_misspelt_stage_names_the_option_and_the_stage_meant(
    select: Selection, says: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=says):
        go(tmp_path, select=select)
