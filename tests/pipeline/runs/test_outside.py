"""Stages of other runs as inputs: found, checked, followed, and noticed when they change or go."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.lookup import finished_stages, generators_of
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    Every,
    FunctionStage,
    StageCache,
    StageConfig,
    StageContext,
)
from motionloom.pipeline.runs.api import evaluate_run, report_run, run_recipe
from motionloom.pipeline.runs.plan import make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.artifact import Artifact, require_consistent
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.run_folder import identity_of
from motionloom.pipeline.store.run_state import finished_records, run_state

QUIET = Console(quiet=True)


class AddConfig(StageConfig):
    add: int = 1


class Loading(FunctionStage):
    """Loads what its inputs add up to: all of them are needed."""

    def load(self, stage, given, device):  # type: ignore[no-untyped-def]
        return sum(given[role] for role in given) + stage.config.add


def add_up(context: StageContext) -> None:
    write_json(context.folder / "value.json", sum(context.given.values()) + context.config.add)
    (context.folder / "report.html").write_text("a page")


@pytest.fixture(autouse=True)
def kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    def kind(name: str, takes: tuple[str | Every, ...], gives: str, trains: bool = False) -> Loading:
        given = frozenset({gives, name})
        return Loading(name, "a toy", AddConfig, add_up, takes, trains=trains, offers=given)

    register_toys(
        monkeypatch,
        kind("root", (), "data"),
        kind("net", ("data", "start?: net"), GENERATOR, trains=True),
        kind("judge", ("about?: net", Every("generators", GENERATOR)), "figures"),
        kind("page", ("net",), "page"),
    )


OTHER = "name: other\nstages: {data: {kind: root, add: 10}, net: {kind: net, add: 5}}"
MINE = """
name: mine
stages:
  data: {kind: root, add: 100}
  net: {kind: net, inputs: {start: runs/other/stages/net}}
  judge: {kind: judge, inputs: {generators: [net, runs/other/stages/net]}}
  figures: {kind: judge, inputs: {about: runs/other/stages/net, generators: [net]}}
"""


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """`runs/other`, finished, below the current folder."""
    monkeypatch.chdir(tmp_path)
    go(OTHER, "runs/other")
    return tmp_path / "runs"


def go(text: str, out: str, *sets: str, recipe: str = "recipe.yaml", replace: bool = False) -> Path:
    Path(recipe).write_text(text)
    return run_recipe(recipe, Path(out), overrides=sets, replace=replace, console=QUIET)


def value(run: str, stage: str) -> int:
    return int(json.loads(Path(run, "stages", stage, "value.json").read_text()))


def test_a_stage_of_another_run_feeds_one_of_this(runs: Path) -> None:
    go(MINE, "runs/mine")
    # other: data 10, net 15; mine: data 100, net 100 + 15 + 1, judge both nets.
    assert value("runs/mine", "net") == 116 and value("runs/mine", "judge") == 132
    artifact = Artifact.find(runs / "mine/stages/net")
    assert artifact is not None
    source = artifact.inputs["start"]
    assert (source.stage, source.folder) == ("net", "../other/stages/net")
    assert source.fingerprint == identity_of(runs / "other/stages/net")
    assert "folder" not in artifact.dump()["inputs"]["data"]
    assert Artifact.parse(artifact.dump(), "again") == artifact
    assert list(Artifact.find(runs / "mine/stages/judge").inputs) == [  # type: ignore[union-attr]
        "generators.net",
        "generators.other:net",
    ]


def test_what_follows_inputs_goes_into_the_other_run(runs: Path) -> None:
    run = go(MINE, "runs/mine")
    stages = finished_stages(run)
    start = stages["net"].inputs["start"]
    assert start.outside and start.name == "other:net" and not start.inputs["data"].inputs
    assert [stage.name for stage in stages["net"].upstream()] == ["data", "other:net", "other:data"]
    assert StageCache().get(stages["net"]) == 116, "loaded with what is above it there"
    assert [stage.name for stage in generators_of(run)] == ["net", "other:net"]
    record = finished_records(run)["judge"]
    assert {role: one.name for role, one in record.inputs.items()} == {
        "generators.net": "net",
        "generators.other:net": "other:net",
    }
    assert list(finished_records(run)) == ["data", "net", "judge", "figures"]
    evaluate_run(run, console=QUIET)
    assert json.loads((run / "evaluate/value.json").read_text()) == 132


def test_its_recipe_runs_again_from_anywhere(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths of a resolved recipe are seen from its own folder; moved together, both still find each other."""
    run = go(MINE, "runs/mine")
    assert "start: ../other/stages/net" in (run / "recipe.yaml").read_text()
    plan = make_plan(load_recipe(run / "recipe.yaml"), run)
    assert {row.action for row in plan} == {"skip"}
    moved = runs.rename(runs.parent / "moved")
    elsewhere = runs.parent / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    plan = make_plan(load_recipe(moved / "mine/recipe.yaml"), moved / "mine")
    assert {row.action for row in plan} == {"skip"}
    require_consistent(moved / "mine", ["judge"])
    assert StageCache().get(finished_stages(moved / "mine")["net"]) == 116


def test_a_recipe_beside_the_run_or_seen_from_here(runs: Path) -> None:
    for place in ("../runs/other/stages/net", "runs/other/stages/net", str(runs / "other/stages/net/")):
        text = MINE.replace("runs/other/stages/net", place)
        Path("recipes").mkdir(exist_ok=True)
        Path("recipes/mine.yaml").write_text(text)
        loaded = load_recipe("recipes/mine.yaml")
        assert list(loaded.outside) == ["runs/other/stages/net"]
    set_ = load_recipe("recipes/mine.yaml", ["net.inputs.start=./runs/../runs/other/stages/net"])
    assert set_.outside == loaded.outside


def test_another_run_that_has_changed_is_noticed(runs: Path) -> None:
    run = go(MINE, "runs/mine")
    assert make_plan(load_recipe("recipe.yaml"), run)[1].action == "skip"
    # Forced again, a training has the same fingerprint and may have other weights.
    (runs / "other/stages/net/value.json").write_text("16")
    artifact = Artifact.load_json(runs / "other/stages/net/artifact.json")
    artifact.finish(runs / "other/stages/net")
    row = make_plan(load_recipe("recipe.yaml"), run)[1]
    assert (row.action, row.reason) == ("run", "input runs/other/stages/net changed")
    said = f"'judge' .*another 'net' of {runs / 'other'}, "
    with pytest.raises(UserError, match=said):
        require_consistent(run, ["judge"])
    with pytest.raises(UserError, match=r"'net' .*another 'net'"):
        evaluate_run(run, console=QUIET)
    assert f"'net' of {runs / 'other'} " in "; ".join(stage.why for stage in run_state(run).unfinished)
    with pytest.raises(UserError, match=r"  net: input runs/other/stages/net changed"):
        run_recipe("recipe.yaml", run, console=QUIET)
    run_recipe("recipe.yaml", run, replace=True, console=QUIET)
    require_consistent(run, ["judge"])


def test_another_run_made_of_mixed_stages_is_refused(runs: Path) -> None:
    recipe = (runs / "other/recipe.yaml").read_text()
    go(recipe.replace("add: 10", "add: 11"), "runs/other", recipe="again.yaml", replace=True)
    fresh = identity_of(runs / "other/stages/net")
    go(MINE, "runs/mine")
    data = runs / "other/stages/data"
    artifact = Artifact.load_json(data / "artifact.json")
    artifact.model_copy(update={"fingerprint": "0" * 64}).finish(data)
    assert identity_of(runs / "other/stages/net") == fresh
    with pytest.raises(UserError, match=r"'net' .*another 'data'"):
        load_recipe("recipe.yaml")
    with pytest.raises(UserError, match=r"'net' .*another 'data'"):
        require_consistent(runs / "mine", ["net"])


def test_another_run_that_is_gone(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages that load without it are still there; the recipe, and stages that need it, say where it was."""
    run = go(MINE + "  report: {kind: page}\n", "runs/mine")
    (runs / "other").rename(runs / "away")
    for use in (lambda: evaluate_run(run, console=QUIET), lambda: report_run(run, None, console=QUIET)):
        with pytest.raises(UserError, match=r"stages\.net\.inputs\.start: runs/other/stages/net: "):
            use()
    assert [stage.name for stage in generators_of(run)] == ["net"]
    monkeypatch.setattr(Loading, "exports", ("start",))
    with pytest.raises(UserError, match=f"{run}: stage 'net' .* {runs / 'other/stages/net'}, "):
        finished_stages(run)
    (runs / "away").rename(runs / "other")
    report_run(run, None, console=QUIET)
    evaluate_run(run, console=QUIET)


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("runs/otter/stages/net", r"net.inputs.start: runs/otter/stages/net: no such folder"),
        ("runs/other/stages/nte", r"runs/other/stages/nte: no such folder; did you mean 'net'"),
        ("runs/other", r"runs/other: a whole run; name one of its stages.*data, net"),
        ("runs/other/stages", r"no finished stage \(no artifact.json\); name the folder of a stage"),
        ("runs/other/stages/data", r"its input 'start' is the stage '.*data' of kind root, which is no net"),
        ("[net, runs/other/stages/data]", "'runs/other/stages/data' is no stage that gives a generator"),
        ("[runs/other/stages/net, runs/sub/other/stages/net]", "two .*'other:net'"),
    ],
)
def test_what_is_no_stage_is_refused(place: str, says: str, runs: Path) -> None:
    Path("recipe.yaml").write_text(MINE)
    shutil.copytree(runs / "other", runs / "sub/other")
    role = "judge.inputs.generators" if place.startswith("[") else "net.inputs.start"
    with pytest.raises(UserError, match=says):
        load_recipe("recipe.yaml", [f"{role}={place}"])


def test_a_stage_of_another_version_or_with_a_file_missing(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("recipe.yaml").write_text(MINE)
    net = runs / "other/stages/net"
    (net / "value.json").rename(net / "old.json")
    with pytest.raises(UserError, match=r"value\.json .*: motionloom"):
        load_recipe("recipe.yaml")
    (net / "old.json").rename(net / "value.json")
    root = Loading("root", "a toy", AddConfig, add_up, version=2, offers=frozenset({"data"}))
    register_toys(monkeypatch, root)
    text = MINE.replace("start: runs/other/stages/net", "data: runs/other/stages/data")
    Path("recipe.yaml").write_text(text.replace("  data: {kind: root, add: 100}\n", ""))
    with pytest.raises(UserError, match=r"'data' .*version 1 .*version 2"):
        load_recipe("recipe.yaml")


def test_a_run_does_not_read_itself_from_outside(runs: Path) -> None:
    run = go(MINE, "runs/mine")
    text = MINE.replace("runs/other/stages/net", "runs/mine/stages/data", 1)
    Path("recipe.yaml").write_text(text.replace("start:", "data:"))
    with pytest.raises(UserError, match=r"this very run; .*'data'"):
        make_plan(load_recipe("recipe.yaml"), run)
    back = OTHER.replace("{kind: net, add: 5}", "{kind: net, inputs: {start: runs/mine/stages/net}}")
    Path("recipe.yaml").write_text(back)
    with pytest.raises(UserError, match=r"mine:net .* runs/other"):
        make_plan(load_recipe("recipe.yaml"), Path("runs/other"))


def test_one_that_changes_while_a_stage_runs_is_noticed(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def meddle(context: StageContext) -> None:
        add_up(context)
        (runs / "other/stages/net/artifact.json").unlink()

    takes = ("data", "start?: net")
    net = Loading("net", "a toy", AddConfig, meddle, takes, trains=True, offers=frozenset({GENERATOR}))
    register_toys(monkeypatch, net)
    with pytest.raises(UserError, match="made again while"):
        go(MINE, "runs/mine")
    assert Artifact.find(runs / "mine/stages/net") is None
