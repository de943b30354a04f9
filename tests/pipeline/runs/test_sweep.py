"""Every combination of some settings: folders, what is shared, going on, one of them, and the table."""

from __future__ import annotations

import io
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import FunctionStage, StageConfig, StageContext
from motionloom.pipeline.runs.graph import make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.sweep import Axis, run_sweep
from motionloom.pipeline.runs.take_over import take_over
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.files import write_json

RECIPE = """
name: swept
data_seed: 3
stages:
  data: {kind: data}
  net: {kind: net}
  evaluate: {kind: evaluate}
"""
RAN: list[str] = []


class AddConfig(StageConfig):
    add: float = 1
    words: tuple[str, ...] = ("a",)


def work(context: StageContext) -> None:
    RAN.append(f"{context.folder.parent.parent.name}/{context.name}")
    above = [json.loads((stage.folder / "value.json").read_text()) for stage in context.inputs.values()]
    value = sum(above) + context.config.add + 100 * (context.name == "net") * context.seed
    write_json(context.folder / "value.json", value)
    if context.name == "net":
        (context.folder / "checkpoints").mkdir()
        (context.folder / "checkpoints/last.ckpt").write_text("weights")
    if context.name == "evaluate":
        figures = {"reconstruction_mm": {"reconstructed": {"mpjpe": value}}}
        write_json(context.folder / "metrics.json", figures)
    if context.config.add < 0:
        raise KeyboardInterrupt


Sweep = Callable[..., str]


@pytest.fixture
def go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sweep:
    """`go("net.add=1,2", index=0)`: what was printed; runs lie in `tmp_path / "sweep"`."""
    for name, takes in (("data", ()), ("net", ("data",)), ("evaluate", ("net",))):
        given = frozenset({"figures"} if name == "evaluate" else ())
        kind = FunctionStage(name, "a toy", AddConfig, work, takes, trains=name == "net", given_names=given)
        register_toys(monkeypatch, kind)
    RAN.clear()

    def sweep(*over: str, sets: tuple[str, ...] = (), **more: object) -> str:
        path = tmp_path / "recipe.yaml"
        path.write_text(RECIPE)
        printed = io.StringIO()
        run_sweep(
            path, over, tmp_path / "sweep", overrides=["hardware.accelerator=cpu", *sets],
            console=Console(file=printed, width=300), **more,  # type: ignore[arg-type]
        )  # fmt: skip
        return printed.getvalue()

    return sweep


def value(tmp_path: Path, run: str, stage: str) -> float:
    return float(json.loads((tmp_path / "sweep" / run / "stages" / stage / "value.json").read_text()))


def test_each_combination_is_a_run_and_the_data_is_made_once(go: Sweep, tmp_path: Path) -> None:
    said = go("net.add=2,3e0", "seed=1,2")
    names = ["add=2_seed=1", "add=2_seed=2", "add=3e0_seed=1", "add=3e0_seed=2"]
    assert [path.name for path in sorted((tmp_path / "sweep").iterdir())] == names
    assert [value(tmp_path, name, "net") for name in names] == [103, 203, 104, 204]
    assert [name for name in RAN if name.endswith("data")] == ["add=2_seed=1/data"]
    assert len(RAN) == 1 + 2 * 4
    assert "    made already in add=2_seed=1: data\n" in said
    # The table: no figure of a run is computed again, and the best is marked.
    rows = [line for line in said.splitlines() if line.startswith("│")]
    assert [row.split("│")[1].strip() for row in rows] == ["2", "2", "3e0", "3e0"]
    assert f"motionloom compare {tmp_path / 'sweep' / names[0]} " in said
    RAN.clear()
    assert "all 3 stages are finished" in go("net.add=2,3e0", "seed=1,2") and not RAN


def test_what_is_taken_over_is_the_other_runs(go: Sweep, tmp_path: Path) -> None:
    go("evaluate.add=1,2")
    one, two = (tmp_path / "sweep" / f"add={n}" / "stages" for n in (1, 2))
    assert [name for name in RAN if not name.endswith("evaluate")] == ["add=1/data", "add=1/net"]
    for stage in ("data", "net"):
        assert (one / stage / "artifact.json").read_bytes() == (two / stage / "artifact.json").read_bytes()
        assert (one / stage / "value.json").samefile(two / stage / "value.json")
    checkpoints = [run / "net/checkpoints/last.ckpt" for run in (one, two)]
    assert not checkpoints[0].samefile(checkpoints[1]) and checkpoints[1].read_text() == "weights"
    assert not (one / "evaluate/value.json").samefile(two / "evaluate/value.json")


def test_a_run_that_takes_over_everything_is_a_run(go: Sweep, tmp_path: Path) -> None:
    assert "made already in threads=1: data, net, evaluate" in go("hardware.threads=1,2")
    assert len(RAN) == 3
    assert "threads: 2" in (tmp_path / "sweep/threads=2/recipe.yaml").read_text()


def test_a_killed_sweep_goes_on(go: Sweep, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        go("net.add=1,-1,2")
    assert RAN == ["add=1/data", "add=1/net", "add=1/evaluate", "add=-1/net"]
    half = tmp_path / "sweep/add=2/stages/.data.taken"
    half.mkdir(parents=True)
    (half / "torn").write_text("")
    RAN.clear()
    go("net.add=1,2")
    assert RAN == ["add=2/net", "add=2/evaluate"]
    assert not half.exists()


def test_one_of_them_for_a_job_of_a_cluster(go: Sweep, tmp_path: Path) -> None:
    said = go("seed=4,5,6", index=1)
    assert [path.name for path in (tmp_path / "sweep").iterdir()] == ["seed=5"]
    assert "sweep 2/3 seed=5" in said and "motionloom compare" not in said
    go("seed=4,5,6", index=2)
    assert "seed=6/data" not in RAN, "what another job has finished is taken over"
    with pytest.raises(UserError, match="--index 3: there are 3 combinations; take 0 to 2"):
        go("seed=4,5,6", index=3)


def test_a_dry_run_says_what_each_would_do(go: Sweep, tmp_path: Path) -> None:
    said = go("net.add=2,3", dry_run=True)
    assert not (tmp_path / "sweep").exists() and not RAN
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.splitlines() if "add=" in line]
    assert rows == [["0", "add=2", "2", "3 of 3", ""], ["1", "add=3", "3", "2 of 3", "data"]]


def test_finished_trainings_of_a_sweep_are_not_replaced_unasked(go: Sweep) -> None:
    go("seed=1,2")
    RAN.clear()
    with pytest.raises(UserError, match=r"seed=1: this would replace 1 finished stage"):
        go("seed=1,2", sets=("net.add=7",))
    assert not RAN
    go("seed=1,2", sets=("net.add=7",), replace=True)
    assert len(RAN) == 4


def test_only_what_is_finished_and_the_same_is_taken(go: Sweep, tmp_path: Path) -> None:
    go("seed=1")
    source, target = tmp_path / "sweep/seed=1", tmp_path / "other"
    recipe = load_recipe(source / "recipe.yaml")
    (source / "stages/net/value.json").unlink()
    assert set(take_over(make_plan(recipe, target), target, [source])) == {"data", "evaluate"}
    assert Artifact.find(target / "stages/net") is None
    assert take_over(make_plan(recipe, target), target, [source]) == {}


@pytest.mark.parametrize(
    ("over", "says"),
    [
        ((), "name what is swept over"),
        (("net.add",), "--over net.add: write it as stage.field=value,value"),
        (("net.add=1,",), "write it as"),
        (("net.add=1,1",), "names a value twice"),
        (("net.add=1", "net.add=2"), "--over names a setting twice"),
        (("net.ad=1,2",), "unknown key 'ad'; did you mean 'add'"),
        (("nte.add=1,2",), "no stage 'nte'; did you mean 'net'"),
        (("net.words=[a/b],[a-b]",), "two combinations would be called words=a-b"),
    ],
)
def test_mistakes_are_refused_before_anything_runs(
    over: tuple[str, ...], says: str, go: Sweep, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=says):
        go(*over)
    assert not (tmp_path / "sweep").exists()


def test_values_and_names(go: Sweep, tmp_path: Path) -> None:
    assert Axis.parse("a.b=[1, 2],'x,y',{c: 1, d: 2}").values == ("[1, 2]", "'x,y'", "{c: 1, d: 2}")
    go("net.add=1", "data.add=2", "net.words=[x, y]")
    assert [path.name for path in (tmp_path / "sweep").iterdir()] == ["net.add=1_data.add=2_net.words=x-y"]


def test_runs_of_several_processes_are_commands_of_their_own(
    go: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes form one team, once; the first run's would otherwise go on to the second's."""
    commands: list[list[str]] = []

    def note(command: list[str], *, check: bool) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 3 if "seed=2" in command else 0)

    monkeypatch.setattr(subprocess, "run", note)
    with pytest.raises(UserError, match=r"seed=2: stopped with exit code 3; the same command goes on"):
        go("seed=1,2,3", sets=("hardware.cpu_devices=2",), replace=True)
    assert not RAN and len(commands) == 2
    folder = tmp_path / "sweep/seed=1"
    words = "--out {} --set hardware.accelerator=cpu --set hardware.cpu_devices=2 --set seed=1 --replace"
    assert commands[0][1:] == [
        "-P", "-m", "motionloom.pipeline.cli.main", "run", str(tmp_path / "recipe.yaml"),
        *words.format(folder).split(),
    ]  # fmt: skip
    monkeypatch.setenv("RANK", "1")
    with pytest.raises(UserError, match="give them one combination, --index K"):
        go("seed=1,2")
