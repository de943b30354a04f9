"""The stage graph: skip, re-run, resume, select; on stages that only write a number."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.lock import file_lock
from motionloom.pipeline.contract.fingerprint import RUNTIME
from motionloom.pipeline.contract.stage import Every, FunctionStage, StageConfig, StageContext
from motionloom.pipeline.runs.execute import execute
from motionloom.pipeline.runs.plan import REQUEST_FILE, Selection, make_plan
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


def kind(
    name: str, *takes: str | Every, work: Callable[[StageContext], None] | None = None, **more: Any
) -> Any:
    """A kind of stage that adds up, whatever `run_add` is by then."""
    return FunctionStage(
        name, "a sum", AddConfig, work or (lambda c: run_add(c)), takes, offers=NUMBER, **more
    )


TAKES = ("left: number", "right?: number")


@pytest.fixture(autouse=True)
def toy_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    every = FunctionStage("all", "a sum", AddConfig, run_add, (Every("numbers", "number"),))
    register_toys(monkeypatch, kind("root"), kind("sum", *TAKES), every)


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


ALL = ["left", "right", "both", "one", "top"]


def test_runs_all_and_then_what_changed_and_all_below(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert go(tmp_path) == ALL and value(tmp_path, "top") == 122
    artifact = Artifact.find(tmp_path / "run/stages/both")
    assert artifact is not None and set(artifact.outputs) == {"value.json"}
    assert {role: i.stage for role, i in artifact.inputs.items()} == {"left": "left", "right": "right"}
    plan = make_plan(recipe(tmp_path, "left.add=2"), tmp_path / "run")
    reasons = {row.stage.name: row.reason for row in plan}
    assert reasons["left"].endswith("add 1 -> 2") and reasons["both"] == "input left changed"
    assert reasons["right"] == "finished"
    for overrides, ran in (
        ((), []),
        (("left.workers=7", "hardware.workers=3"), []),  # they change no number
        (("left.add=2",), ["left", "both", "top"]),
        (("left.add=2", "top.add=0"), ["top"]),
        (("seed=5",), ALL),
        (("seed=5",), []),
    ):
        assert go(tmp_path, *overrides) == ran
    (tmp_path / "run/stages/both/value.json").unlink()
    assert go(tmp_path, "seed=5") == ["both"]
    register_toys(monkeypatch, kind("sum", *TAKES, version=2))
    assert go(tmp_path, "seed=5") == ["both", "one", "top"]


def test_selection(tmp_path: Path) -> None:
    assert go(tmp_path, select=Selection(until="both")) == ["left", "right", "both"]
    with pytest.raises(UserError, match="did you mean 'both'"):
        go(tmp_path, select=Selection(until="bot"))
    assert go(tmp_path, select=Selection(until="left, one")) == ["one"]
    with pytest.raises(UserError, match="did you mean 'one'"):
        go(tmp_path, select=Selection(until="left,ones"))
    go(tmp_path)
    assert go(tmp_path, select=Selection(first="both")) == ["both", "top"]
    for _ in range(2):
        assert go(tmp_path, select=Selection(first="one", until="one")) == ["one"]


@pytest.mark.parametrize(
    ("select", "asked"),
    [
        (Selection(first="left"), ["left", "both", "top"]),
        (Selection(first="both"), ["both", "top"]),
        (Selection(first="left", until="both"), ["left", "both"]),
        (Selection(first="one", until="one"), ["one"]),
    ],
)
def test_what_a_command_began_to_run_again_the_same_command_goes_on_with(
    select: Selection, asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in its last stage: those before it are not made a second time, and that one resumes."""
    go(tmp_path)
    run, last = tmp_path / "run", asked[-1]
    kept = run / "stages" / last / "checkpoint"

    whole = run_add

    def killed(context: StageContext) -> None:
        whole(context)
        if context.name == last:
            kept.touch()
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setitem(globals(), "run_add", killed)
        go(tmp_path, select=select)
    plan = {row.stage.name: row.action for row in make_plan(recipe(tmp_path), run, select)}
    assert {plan.pop(last), *plan.values()} <= {"resume", "skip", "leave"} and kept.exists()
    assert go(tmp_path, select=select) == [last] and kept.exists()
    assert not (run / REQUEST_FILE).exists()
    assert go(tmp_path, select=select) == asked, "asked once more, all run again"
    assert go(tmp_path) == [] and not kept.exists()


def test_another_command_between_drops_the_request(tmp_path: Path) -> None:
    go(tmp_path)
    select = Selection(first="right")
    loaded, run = recipe(tmp_path), tmp_path / "run"
    write_json(run / REQUEST_FILE, asdict(select))
    assert [row.action for row in make_plan(loaded, run, Selection(first="left"))].count("run") == 3
    assert go(tmp_path, "one.add=2") == ["one"] and not (run / REQUEST_FILE).exists()
    assert go(tmp_path, "one.add=2", select=select) == ["right", "both", "one", "top"]


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
    # The first of several generators is the default, so another order makes something else.
    turned = several(tmp_path, "listed.inputs.numbers=[first, second]")
    rows = {row.stage.name: (row.action, row.reason) for row in make_plan(turned, run)}
    action, reason = rows.pop("listed")
    assert action == "run" and "order of inputs" in reason
    assert {action for action, _ in rows.values()} == {"skip"}


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("listed.inputs.numbers=[frst]", "'frst' is no stage that gives a number; did you mean 'first'"),
        ("listed.inputs.numbers=[every]", "'every' is no stage that gives a number"),
        ("listed.inputs.numbers=7", r"numbers must list stages, like \[gpt\]"),
        ("listed.inputs.number=[first]", "unknown role 'number'; did you mean 'numbers'"),
    ],
)
def test_a_list_of_what_does_not_fit_is_refused(override: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        several(tmp_path, override)


def test_two_processes_do_not_share_a_run(tmp_path: Path) -> None:
    (tmp_path / "run/.locks").mkdir(parents=True)
    held = file_lock(tmp_path / "run/.locks" / ALL[-1])
    with held, pytest.raises(UserError, match=f"working on this run's stage '{ALL[-1]}'"):
        go(tmp_path)
    assert go(tmp_path) == ALL


def test_jobs_of_two_branches_work_in_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While one is made, `both` is; what `one` reads stays as it is. All is as one process makes it."""
    go(tmp_path, select=Selection(until="left,right"))

    def beside(context: StageContext) -> None:
        run_add(context)
        if context.name == "one":
            assert go(tmp_path, select=Selection(until="both")) == ["both"]
            with pytest.raises(UserError, match="stage 'right'"):
                go(tmp_path, select=Selection(first="right", until="both"))

    register_toys(monkeypatch, kind("sum", *TAKES, work=beside))
    assert go(tmp_path, select=Selection(until="one")) == ["one"] and go(tmp_path) == ["top"]
    made = {path: path.read_bytes() for path in sorted((tmp_path / "run/stages").rglob("[!t]*.json"))}
    (tmp_path / "run").rename(tmp_path / "old")
    register_toys(monkeypatch, kind("sum", *TAKES))
    assert go(tmp_path) == ALL and made == {path: path.read_bytes() for path in made}
