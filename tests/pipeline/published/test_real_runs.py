"""Keys of the tables against what real runs write, and evaluations of a tokenizer alone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from motionloom.pipeline.published.answers import answers
from motionloom.pipeline.published.evaluations import Evaluation, evaluations_of
from motionloom.pipeline.published.fill import fill
from motionloom.pipeline.published.schema import Measure
from motionloom.pipeline.published.shipped import paper_table, shipped_tables

pytestmark = pytest.mark.slow

Call = Callable[..., Any]

STILL = ("ground_truth", "nearest_music", "random_training_dance", "shuffled_music", "mean_pose")

# One row of an evaluation has what another has not: recorded motion has no FID to itself, for instance.
WITHOUT = {
    "distribution.rows.recorded.fid",
    "distribution.rows.recorded.multimodality",
    "distribution.rows.training.multimodality",
    "distribution.rows.mean_pose.multimodality",
    "retrieval.chance.matching_score",
    "by_evaluator.matching.chance.matching_score",
    *(f"movement.rows.recorded.fid_{kind}" for kind in "km"),
    *(f"movement.rows.{row}.mm_{kind}" for row in ("recorded", "training", "mean_pose") for kind in "km"),
    *(f"rows.{row}.multimodality.mm_{kind}" for row in STILL for kind in "km"),
    *(f"rows.shuffled_music.distribution.{name}_{kind}" for name in ("fid", "div") for kind in "km"),
}


OPTIONAL = {
    "by_evaluator": lambda figures: "by_evaluator" in figures,
    "by_face_evaluator": lambda figures: "by_face_evaluator" in figures,
    "reconstruction_latents.evaluator": lambda figures: "evaluator" in figures["reconstruction_latents"],
    "reconstruction_latents.face_evaluator": (
        lambda figures: "face_evaluator" in figures["reconstruction_latents"]
    ),
    "reconstruction_face.vertex": lambda figures: "vertex" in figures["reconstruction_face"],
}
"""Where the keys of a judge or a head begin -> whether an evaluation has it."""


def keys(measure: Measure) -> set[str]:
    """Of all columns that take figures of `measure`."""
    found = set()
    for name in shipped_tables():
        table = paper_table(name)
        for column in table.columns:
            if column.figure is not None and column.of == measure:
                values = [row.values for row in table.rows if row.values] or [{}]
                found |= {column.figure.format(**one) for one in values}
    return found


def require_all(evaluation: Evaluation) -> None:
    """Every key, and every answer that stands beside it, has a number."""
    wanted = keys(evaluation.measure)
    assert wanted
    captioned = evaluation.measure == "evaluate"
    absent = tuple(key for key, has in OPTIONAL.items() if captioned and not has(evaluation.figures))
    for key in wanted:
        if absent and key.startswith(absent):
            assert evaluation.value(key) is None
            continue
        assert evaluation.value(key) is not None, key
        for answer in answers(key).values():
            if answer.startswith("rows.shuffled_music.") and evaluation.figures["songs"] == 1:
                continue  # there is no other song to compare with
            assert (evaluation.value(answer) is None) == (answer in WITHOUT), answer


@pytest.fixture
def run(small_run: Any, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_run.folder, tmp_path / "run"))


def test_keys_of_texts_and_retrieval(small_run: Any, run: Path, tmp_path: Path, call: Call) -> None:
    recipe = tmp_path / "more.yaml"
    recipe.write_text(
        f"extends: {small_run.recipe}\nname: small\nstages:\n  evaluate: {{repeats: 2}}\n"
        "  alone: {kind: evaluate, clips: 6, inputs: {face_tokenizer: null, tma: null, generators: []}}\n"
    )
    for stage in ("evaluate", "alone"):
        done = call("run", recipe, "--out", run, "--until", stage)
        assert done.code == 0, done.err
    assert call("retrieval", run).code == 0
    evaluation, alone = evaluations_of(run, ["evaluate"])
    require_all(evaluation)
    require_all(evaluations_of(run, ["retrieval"])[0])
    assert {role: stage.name for role, stage in evaluation.about.items()} == {
        "tokenizer": "tokenizer",
        "face_tokenizer": "face_tokenizer",
        "generator": "gpt",
        "face_generator": "face_gpt",
    }
    # A tokenizer alone is measured as it is beside generators, and nothing is generated.
    assert alone.figures["reconstruction_mm"] == evaluation.figures["reconstruction_mm"]
    assert not {"retrieval", "protocol", "reconstruction_face"} & set(alone.figures)
    for name, label in (("humantomato/7", "run tokenizer"), ("humantomato/13", "run gpt")):
        labels = [row.label for row in fill(name, paper_table(name), [run]).rows if row.source == "ours"]
        assert labels == [label]
    nothing = tmp_path / "nothing.yaml"
    nothing.write_text(
        f"extends: {small_run.recipe}\nname: small\nstages:\n"
        "  alone: {kind: evaluate, inputs: {tokenizer: null, generators: []}}\n"
    )
    done = call("run", nothing, "--out", run, "--until", "alone")
    assert done.code == 2 and "stage 'alone': no tokenizer and no generator to evaluate" in done.err


def test_keys_of_dances(ude_run: Any, tmp_path: Path, call: Call) -> None:
    run = Path(shutil.copytree(ude_run.folder, tmp_path / "run"))
    done = call("run", ude_run.recipe, "--out", run, "--until", "evaluate_dances")
    assert done.code == 0, done.err
    (evaluation,) = evaluations_of(run, ["evaluate_dances"])
    require_all(evaluation)
    assert evaluation.about["generator"].name == "ude"
    table = fill("ude/2", paper_table("ude/2"), [run])
    (row,) = [row for row in table.rows if row.source == "ours"]
    figures = json.loads((run / "stages" / "evaluate_dances" / "dances.json").read_text())
    assert row.method == "Ours" and row.cells[0] is not None
    assert row.cells[0].mean == figures["rows"]["generated"]["beat_align"]["ude"]["mean"]
