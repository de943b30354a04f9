"""A run folder keeps together what belongs together; options that contradict each other are refused."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import ALIGNMENT, GENERATOR, FunctionStage, StageConfig, StageContext
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import evaluate_run, run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.files import write_json

INPUTS = {
    "data": (),
    "stats": ("data",),
    "text": ("data",),
    "tokenizer": ("data",),
    "tma": ("data", "stats", "text"),
    "tokens": ("tokenizer",),
    "gpt": ("tokens", "tma"),
    "evaluate": ("gpt",),
    "report": ("evaluate",),
}
RECIPE = "\n".join(["name: NAME", "stages:", *(f"  {name}: {{kind: {name}}}" for name in INPUTS)])
TRAINED = {"tokenizer", "tma", "gpt"}
GIVES = {"tma": ALIGNMENT, "gpt": GENERATOR, "evaluate": "figures", "report": "page"}
QUIET = Console(quiet=True)


class AddConfig(StageConfig):
    add: int = 1


def work(context: StageContext) -> None:
    write_json(context.folder / "value.json", context.config.add)
    write_text(context.folder / "report.html", "a page")
    if context.config.add < 0:
        write_text(context.folder / "checkpoints" / "step=00000004.ckpt", "")
        raise KeyboardInterrupt


Go = Callable[..., str]


@pytest.fixture
def go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Go:
    """`go("tma.add=2", until="tma", replace=True)`: run into `tmp_path / "run"`; what was printed."""
    for name, inputs in INPUTS.items():
        given = frozenset({GIVES[name]} if name in GIVES else ())
        kind = FunctionStage(name, "a toy", AddConfig, work, inputs, trains=name in TRAINED, offers=given)
        register_toys(monkeypatch, kind)

    def run(
        *overrides: str, recipe: str = "toy", dry_run: bool = False, replace: bool = False, **select: object
    ) -> str:
        path = tmp_path / "recipe.yaml"
        path.write_text(RECIPE.replace("NAME", recipe))
        printed = io.StringIO()
        run_recipe(
            path, tmp_path / "run", overrides=["hardware.accelerator=cpu", *overrides],
            select=Selection(**select), dry_run=dry_run, replace=replace,  # type: ignore[arg-type]
            console=Console(file=printed, width=500),
        )  # fmt: skip
        return printed.getvalue()

    return run


def test_a_folder_with_mixed_stages_is_not_used(go: Go, tmp_path: Path) -> None:
    run = tmp_path / "run"
    go()
    go("tma.add=2", until="tma", replace=True)
    for use in (lambda: Bundle.from_run(run), lambda: evaluate_run(run, console=QUIET)):
        with pytest.raises(UserError, match=r"'gpt' .*another 'tma'") as error:
            use()
        assert f"motionloom run {run / 'recipe.yaml'} -o {run}" in str(error.value)
    run_recipe(run / "recipe.yaml", run, replace=True, console=QUIET)  # the fix
    evaluate_run(run, console=QUIET)
    require_consistent(run, finished_stages(run))
    go("tokenizer.add=2", until="tokenizer", replace=True)  # further up
    with pytest.raises(UserError, match=r"'tokens' .*another 'tokenizer'"):
        evaluate_run(run, console=QUIET)
    go(replace=True)
    go("data.add=2", until="data")
    with pytest.raises(UserError, match="another 'data'"):
        retrieve(run)
    go(replace=True)
    with pytest.raises(KeyboardInterrupt):  # one that is being made anew is another one too
        go("tma.add=-1", until="tma", replace=True)
    with pytest.raises(UserError, match=r"'gpt' .*another 'tma'"):
        Bundle.from_run(run)


def test_the_page_of_other_settings_is_not_shown(go: Go) -> None:
    assert all("watch it:" in said for said in (go(), go(), go(until="tma")))
    assert "watch it:" not in go("tma.add=2", until="tma", replace=True)
    assert "watch it:" in go("tma.add=2", replace=True)


def files(run: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


def took(run: Path, **seconds: float) -> None:
    """As if finished stages had taken so long."""
    for name, time in seconds.items():
        write_json(run / "stages" / name / "timing.json", {"seconds": time, "hardware": "a GPU"})


def test_another_recipe_is_refused_in_the_folder(go: Go, tmp_path: Path) -> None:
    go()
    before = files(tmp_path / "run")
    with pytest.raises(UserError, match=r"(?s)'toy', .*'other'; .*gpt.* --replace"):
        go("gpt.add=2", recipe="other")
    with pytest.raises(UserError, match=r"'other'; -o .*run-2 .*--replace"):
        go("report.add=2", recipe="other")
    said = go("gpt.add=2", recipe="other", dry_run=True)
    assert "--replace" in said and "'toy', not 'other'" in said
    assert before == files(tmp_path / "run")
    assert "2 of 9" not in go("gpt.add=2", recipe="other", replace=True, until="gpt")
    assert json.loads((tmp_path / "run/stages/gpt/value.json").read_text()) == 2


def test_finished_trainings_are_not_replaced_unasked(go: Go, tmp_path: Path) -> None:
    run = tmp_path / "run"
    go()
    took(run, tokenizer=7500.0, gpt=30000.0, evaluate=600.0)
    before = files(run)
    with pytest.raises(UserError) as error:
        go("tokenizer.add=2", "evaluate.add=3")
    parts = [
        (f"{run}: ", "2 stages", "10 h 25 min"),
        ("  tokenizer: ", "add 1 -> 2", "2 h 05 min"),
        ("  gpt: ", "input tokens changed", "8 h 20 min"),
        (f"motionloom run {run}/recipe.yaml -o {run}",),
        (f"-o {run}-2 ", "--replace"),
    ]
    for line, wanted in zip(str(error.value).splitlines(), parts, strict=True):
        assert all(part in line for part in wanted), line
    said = go("tokenizer.add=2", "evaluate.add=3", dry_run=True)
    assert all(line in said for line in str(error.value).splitlines())
    assert files(run) == before
    said = go("tokenizer.add=2", "evaluate.add=3", replace=True)
    assert "stages: tokenizer, gpt\n" in said
    assert said.index("replaces") < said.index("] tokenizer")


def test_what_is_cheap_is_made_anew_without_asking(go: Go, tmp_path: Path) -> None:
    go()
    assert "replaces" not in go("evaluate.add=3")
    assert json.loads((tmp_path / "run/stages/evaluate/value.json").read_text()) == 3
    took(tmp_path / "run", evaluate=3601.0)
    with pytest.raises(UserError, match=r"evaluate: .*3 -> 1 \(1"):
        go()
    (tmp_path / "run/stages/gpt/timing.json").unlink()
    with pytest.raises(UserError, match=r"gpt: .*1 -> 2 .*time"):
        go("gpt.add=2", until="gpt")


def test_what_is_asked_for_by_name_is_made_anew_and_what_was_begun_is_named(go: Go, tmp_path: Path) -> None:
    go()
    assert "3 of 9 " in go("gpt.add=2", first="gpt")
    assert "9 of 9 " in go("tokenizer.add=2", first="data")
    with pytest.raises(UserError, match=r"  tokenizer: .*2 -> 3"):
        go("tokenizer.add=3", first="gpt")
    with pytest.raises(KeyboardInterrupt):
        go("tokenizer.add=2", "gpt.add=-1", replace=True)
    row = json.dumps({"step": 3, "elapsed_seconds": 599.0})
    write_text(tmp_path / "run/stages/gpt/flight/rank_0.jsonl", row + "\n")
    assert "[7/9] gpt" in go("tokenizer.add=2", "gpt.add=5")


def test_ten_minutes_of_a_training_that_is_not_finished_are_guarded(go: Go, tmp_path: Path) -> None:
    """All its processes together; the first one of a run, so no other stage is in the way."""
    with pytest.raises(KeyboardInterrupt):
        go("gpt.add=-1")
    row = json.dumps({"step": 20, "elapsed_seconds": 601.0})
    write_text(tmp_path / "run/stages/gpt/flight/rank_0.jsonl", row + "\n")
    before = files(tmp_path / "run")
    with pytest.raises(UserError, match=r"(?s)1 stage, 10 min .*gpt: .*--replace"):
        go("gpt.add=5")
    assert files(tmp_path / "run") == before
    assert "3 of 9 " in go("gpt.add=5", replace=True)
    write_text(tmp_path / "run/stages/gpt/flight/rank_0.jsonl", row + "\n")
    with pytest.raises(UserError, match="1 stage, 10 min"):  # finished, and the last process was short
        go("gpt.add=6")


def test_options_that_contradict_each_other_and_that_do_not(go: Go) -> None:
    go()
    for first, count in (("tokens", 2), ("gpt", 1)):
        assert f"{count} of 9 " in go(first=first, until="gpt")
    with pytest.raises(UserError, match=r"'tma' .*'gpt'"):
        go(first="gpt", until="tma")
