"""A run folder keeps together what belongs together; options that contradict each other are refused."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from toy_stages import register_toys

from motionloom.datasets.base.files import write_text
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import (
    ALIGNMENT,
    GENERATOR,
    FunctionStage,
    StageConfig,
    StageContext,
)
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import evaluate_run, run_recipe
from motionloom.pipeline.runs.graph import Selection
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.files import write_json

RECIPE = """
name: NAME
stages:
  data: {kind: data}
  stats: {kind: stats}
  text: {kind: text}
  tokenizer: {kind: tokenizer}
  tma: {kind: tma}
  tokens: {kind: tokens}
  gpt: {kind: gpt}
  evaluate: {kind: evaluate}
  report: {kind: report}
"""
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
TRAINED = {"tokenizer", "tma", "gpt"}
GIVES = {"tma": ALIGNMENT, "gpt": GENERATOR, "evaluate": "figures", "report": "page"}


class AddConfig(StageConfig):
    add: int = 1


def work(context: StageContext) -> None:
    write_json(context.folder / "value.json", context.config.add)
    write_text(context.folder / "report.html", "a page")
    if context.config.add < 0:
        (context.folder / "checkpoints").mkdir()
        raise KeyboardInterrupt


Go = Callable[..., str]


@pytest.fixture
def go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Go:
    """`go("tma.add=2", until="tma", replace=True)`: run into `tmp_path / "run"`; what was printed."""
    for name, inputs in INPUTS.items():
        given = frozenset({GIVES[name]} if name in GIVES else ())
        kind = FunctionStage(
            name, "a toy", AddConfig, work, inputs, trains=name in TRAINED, given_names=given
        )
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
    for use in (lambda: Bundle.from_run(run), lambda: evaluate_run(run, console=Console(quiet=True))):
        with pytest.raises(UserError, match="stage 'gpt' was made from another 'tma'") as error:
            use()
        assert f"motionloom run {run / 'recipe.yaml'} -o {run}" in str(error.value)
    run_recipe(run / "recipe.yaml", run, replace=True, console=Console(quiet=True))  # the fix
    evaluate_run(run, console=Console(quiet=True))
    require_consistent(run, finished_stages(run))


def test_it_goes_up_to_the_first_stage(go: Go, tmp_path: Path) -> None:
    go()
    go("tokenizer.add=2", until="tokenizer", replace=True)
    with pytest.raises(UserError, match="stage 'tokens' was made from another 'tokenizer'"):
        evaluate_run(tmp_path / "run", console=Console(quiet=True))
    go(replace=True)
    go("data.add=2", until="data")
    with pytest.raises(UserError, match="was made from another 'data'"):
        retrieve(tmp_path / "run")


def test_a_stage_that_is_being_made_anew_is_another_one_too(go: Go, tmp_path: Path) -> None:
    go()
    with pytest.raises(KeyboardInterrupt):
        go("tma.add=-1", until="tma", replace=True)
    with pytest.raises(UserError, match="stage 'gpt' was made from another 'tma'"):
        Bundle.from_run(tmp_path / "run")


def test_other_settings_of_a_last_stage_mix_nothing(go: Go, tmp_path: Path) -> None:
    go()
    go("evaluate.add=2", until="evaluate")
    evaluate_run(tmp_path / "run", console=Console(quiet=True))


def test_the_page_of_other_settings_is_not_shown(go: Go) -> None:
    assert "watch it:" in go()
    assert "watch it:" in go()
    assert "watch it:" in go(until="tma")
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
    with pytest.raises(UserError, match=r"(?s)of recipe 'toy', not 'other'; to go on .*gpt.* --replace"):
        go("gpt.add=2", recipe="other")
    with pytest.raises(UserError, match=r"'toy', not 'other'; -o .*run-2 keeps both, --replace goes on here"):
        go("report.add=2", recipe="other")
    said = go("gpt.add=2", recipe="other", dry_run=True)
    assert "without --replace this is refused" in said and "holds a run of recipe 'toy', not 'other'" in said
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
    assert str(error.value).splitlines() == [
        f"{run}: this would replace 2 finished stages, 10 h 25 min of work:",
        "  tokenizer: changed: add 1 -> 2 (2 h 05 min of training)",
        "  gpt: input tokens changed (8 h 20 min of training)",
        f"-o {run}-2 keeps both, --replace goes on here: what fits is kept, the rest is made anew",
    ]
    said = go("tokenizer.add=2", "evaluate.add=3", dry_run=True)
    assert "without --replace this is refused." in said
    assert all(line in said for line in str(error.value).splitlines())
    assert files(run) == before
    said = go("tokenizer.add=2", "evaluate.add=3", replace=True)
    assert "replaces finished stages: tokenizer, gpt\n" in said
    assert said.index("replaces") < said.index("] tokenizer")


def test_what_is_cheap_is_made_anew_without_asking(go: Go, tmp_path: Path) -> None:
    go()
    assert "replaces" not in go("evaluate.add=3")
    assert json.loads((tmp_path / "run/stages/evaluate/value.json").read_text()) == 3
    took(tmp_path / "run", evaluate=3601.0)
    with pytest.raises(UserError, match=r"  evaluate: changed: add 3 -> 1 \(1 h 00 min of work\)"):
        go()
    (tmp_path / "run/stages/gpt/timing.json").unlink()
    with pytest.raises(UserError, match=r"  gpt: changed: add 1 -> 2 \(training of unknown time\)"):
        go("gpt.add=2", until="gpt")


def test_a_stage_that_is_asked_for_by_name_is_made_anew(go: Go) -> None:
    go()
    assert "3 of 9 stages to run" in go("gpt.add=2", first="gpt")
    assert "9 of 9 stages to run" in go("tokenizer.add=2", force=True)
    with pytest.raises(UserError, match="  tokenizer: changed: add 2 -> 3"):
        go("tokenizer.add=3", first="gpt")


def test_trainings_that_were_only_begun_are_named(go: Go) -> None:
    go()
    with pytest.raises(KeyboardInterrupt):
        go("gpt.add=-1", replace=True)
    assert "replaces unfinished trainings: gpt\n" in go("gpt.add=5")


def test_nothing_to_do_says_of_how_much(go: Go) -> None:
    go(until="data")
    assert "the selected stages are finished (1 of 9), nothing to do" in go(until="data")
    assert "all 9" not in go(only="data")
    go()
    assert "all 9 stages are finished, nothing to do" in go()
    assert "(1 of 9)" in go(only="data")


@pytest.mark.parametrize(
    ("select", "said"),
    [
        ({"first": "gpt", "until": "tma"}, "'tma' does not need 'gpt'"),
        ({"until": "gpt", "only": "tma"}, "--only tma runs that stage alone: leave --until gpt out"),
        ({"first": "gpt", "only": "tma"}, "--only tma runs that stage alone: leave --from gpt out"),
        ({"first": "gpt", "force": True}, "leave one out"),
    ],
)
def test_options_that_contradict_each_other(go: Go, select: dict[str, object], said: str) -> None:
    go()
    with pytest.raises(UserError, match=said):
        go(**select)


def test_a_range_is_no_contradiction(go: Go) -> None:
    go()
    assert "4 of 9 stages to run" not in go(first="tokens", until="gpt")
    assert "2 of 9 stages to run" in go(first="tokens", until="gpt")
    assert "1 of 9 stages to run" in go(first="gpt", until="gpt")
    assert "1 of 9 stages to run" in go(only="gpt", force=True)
