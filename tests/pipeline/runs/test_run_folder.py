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
    """`go("tma.add=2", until="tma")`: run into `tmp_path / "run"`; what was printed."""
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
    go("tma.add=2", until="tma")
    for use in (lambda: Bundle.from_run(run), lambda: evaluate_run(run, console=Console(quiet=True))):
        with pytest.raises(UserError, match="stage 'gpt' was made from another 'tma'") as error:
            use()
        assert f"motionloom run {run / 'recipe.yaml'} -o {run}" in str(error.value)
    run_recipe(run / "recipe.yaml", run, console=Console(quiet=True))  # the fix
    evaluate_run(run, console=Console(quiet=True))
    require_consistent(run, finished_stages(run))


def test_it_goes_up_to_the_first_stage(go: Go, tmp_path: Path) -> None:
    go()
    go("tokenizer.add=2", until="tokenizer")
    with pytest.raises(UserError, match="stage 'tokens' was made from another 'tokenizer'"):
        evaluate_run(tmp_path / "run", console=Console(quiet=True))
    go()
    go("data.add=2", until="data")
    with pytest.raises(UserError, match="was made from another 'data'"):
        retrieve(tmp_path / "run")


def test_a_stage_that_is_being_made_anew_is_another_one_too(go: Go, tmp_path: Path) -> None:
    go()
    with pytest.raises(KeyboardInterrupt):
        go("tma.add=-1", until="tma")
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
    assert "watch it:" not in go("tma.add=2", until="tma")
    assert "watch it:" in go("tma.add=2")


def test_another_recipe_is_refused_in_the_folder(go: Go, tmp_path: Path) -> None:
    go()
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    for dry_run in (False, True):
        with pytest.raises(UserError, match=r"holds a run of recipe 'toy', not 'other'.*--replace"):
            go("gpt.add=2", recipe="other", dry_run=dry_run)
    assert before == {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    assert "2 of 9" not in go("gpt.add=2", recipe="other", replace=True, until="gpt")
    assert json.loads((tmp_path / "run/stages/gpt/value.json").read_text()) == 2


def test_trainings_that_go_are_named_first(go: Go) -> None:
    assert "replaces" not in go()
    for dry_run in (True, False):
        said = go("tokenizer.add=2", dry_run=dry_run)
        assert "replaces finished trainings: tokenizer, gpt\n" in said
    assert said.index("replaces") < said.index("] tokenizer")
    assert "replaces" not in go("tokenizer.add=2", "evaluate.add=3"), "not a training"
    assert "replaces" not in go("tokenizer.add=2", first="gpt"), "asked for"
    with pytest.raises(KeyboardInterrupt):
        go("tokenizer.add=2", "gpt.add=-1")
    assert "replaces unfinished trainings: gpt\n" in go("tokenizer.add=2", "gpt.add=5")


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
