"""Names of the tables' figures against what real runs write, and evaluations of a tokenizer alone."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from motionloom.pipeline.evaluation.figures import CHANCE, RECORDED, STILL
from motionloom.pipeline.results.paper.compare import paper_table, shipped_tables
from motionloom.pipeline.results.paper.fill import Evaluation, evaluations_of, fill
from motionloom.pipeline.results.paper.schema import Measure

pytestmark = pytest.mark.slow

Call = Callable[..., Any]

OTHER_STAGES = (
    "evaluator.",
    "face_evaluator.",
    "reconstruction.evaluator.",
    "reconstruction.face_evaluator.",
)
"""Begin the names of figures by judges that these runs do not have."""


def require_all(evaluation: Evaluation, measure: Measure) -> None:
    """Every figure that a table names was measured."""
    wanted = set()
    for table in map(paper_table, shipped_tables()):
        for column in table.columns:
            if column.figure is not None and column.of == measure:
                values = [row.values for row in table.rows if row.values] or [{}]
                wanted |= {column.figure.format(**one) for one in values}
    assert wanted
    absent = {name for name in wanted if evaluation.file.of(name) is None}
    assert all(name.startswith(OTHER_STAGES) for name in absent), absent


@pytest.fixture
def run(small_run: Any, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_run.folder, tmp_path / "run"))


def test_figures_of_texts_and_retrieval(small_run: Any, run: Path, tmp_path: Path, call: Call) -> None:
    recipe = tmp_path / "more.yaml"
    recipe.write_text(
        f"extends: {small_run.recipe}\nname: small\nstages:\n  evaluate: {{repeats: 2}}\n"
        "  alone: {kind: evaluate, clips: 6, inputs: {face_tokenizer: null, tma: null, generators: []}}\n"
    )
    for stage in ("evaluate", "alone"):
        done = call("run", recipe, "--out", run, "--until", stage)
        assert done.code == 0, done.err
    assert call("retrieval", run).code == 0
    evaluation, alone = evaluations_of(run, "run", ["evaluate"])
    require_all(evaluation, "evaluate")
    require_all(evaluations_of(run, "run", ["retrieval"])[0], "retrieval")
    assert {role: stage.name for role, stage in evaluation.about.items()} == {
        "tokenizer": "tokenizer",
        "face_tokenizer": "face_tokenizer",
        "generator": "gpt",
        "face_generator": "face_gpt",
    }
    # Beside every figure stand the answers that need no model.
    for name, row in (("tma.m2t_r1", CHANCE), ("tma.m2t_r1", RECORDED), ("tma.fid", STILL)):
        assert evaluation.file.of(name, row) is not None
    # A tokenizer alone is measured as it is beside generators, and nothing is generated.
    errors = [one for one in evaluation.file.figures if one.name.startswith("reconstruction.mpjpe")]
    assert errors and all(one in alone.file.figures for one in errors)
    assert {one.name.split(".")[0] for one in alone.file.figures} == {"reconstruction"}
    for name, label in (("humantomato/7", "run tokenizer"), ("humantomato/13", "run gpt")):
        labels = [row.label for row in fill(name, paper_table(name), [run]).rows if row.source == "ours"]
        assert labels == [label]
    nothing = tmp_path / "nothing.yaml"
    nothing.write_text(
        f"extends: {small_run.recipe}\nname: small\nstages:\n"
        "  alone: {kind: evaluate, inputs: {tokenizer: null, generators: []}}\n"
    )
    done = call("run", nothing, "--out", run, "--until", "alone")
    assert done.code == 2 and "'alone': no tokenizer and" in done.err


def test_figures_of_dances(ude_run: Any, tmp_path: Path, call: Call) -> None:
    run = Path(shutil.copytree(ude_run.folder, tmp_path / "run"))
    done = call("run", ude_run.recipe, "--out", run, "--until", "evaluate_dances")
    assert done.code == 0, done.err
    (evaluation,) = evaluations_of(run, "run", ["evaluate_dances"])
    require_all(evaluation, "evaluate_dances")
    assert evaluation.about["generator"].name == "ude"
    table = fill("ude/2", paper_table("ude/2"), [run])
    (row,) = [row for row in table.rows if row.source == "ours"]
    figure = evaluation.file.of("beat_align.bailando")
    assert row.method == "Ours" and row.cells[0] is not None and figure is not None
    assert row.cells[0].text.startswith(f"{figure.value:.4f}")
