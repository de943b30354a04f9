"""Which rows of which runs stand in a table, with which figures, and which of them are ranked."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import run_records as records

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.evaluation.figures import CHANCE, STILL, TRAINING, FigureFile
from motionloom.pipeline.results.paper.compare import paper_table
from motionloom.pipeline.results.paper.fill import fill
from motionloom.pipeline.results.paper.filled import FilledRow, FilledTable
from motionloom.pipeline.results.paper.schema import StageMatch, fits
from motionloom.pipeline.store.run_state import StageRecord, finished_records

Make = Callable[..., Path]


def filled(name: str, *runs: Path) -> FilledTable:
    return fill(name, paper_table(name), runs)


def measured(tokenizer: str, figures: FigureFile) -> dict[str, Any]:
    """An evaluation of a tokenizer."""
    return {"kind": "evaluate", "inputs": {"data": "data", "tokenizer": tokenizer}, "figures": figures}


def texts(row: FilledRow) -> list[str]:
    return ["" if cell is None else cell.text for cell in row.cells]


def ours(table: FilledTable) -> dict[str, list[str]]:
    """Label -> cells of our models' rows."""
    return {row.label: texts(row) for row in table.rows if row.source == "ours"}


def best(table: FilledTable) -> dict[str, list[int]]:
    """Label -> columns that are marked."""
    marks = {row.label: [at for at, cell in enumerate(row.cells) if cell and cell.best] for row in table.rows}
    return {label: found for label, found in marks.items() if found}


def test_a_row_takes_the_figures_of_the_evaluation_of_its_model(baselines: Make) -> None:
    table = filled("humantomato/7", baselines())
    assert ours(table) == {
        "bl vq": ["140.00", "70.00", "46.67", "", "", "", ""],
        "bl rvq": ["110.00", "55.00", "36.67", "", "", "", ""],
        "bl tokenizer": ["90.00", "45.00", "30.00", "", "", "", ""],
    }
    order = [(row.source, row.method) for row in table.rows if row.source != "reference"]
    assert order == [
        ("paper", "Vanilla VQ (512)"),
        ("ours", "Vanilla VQ (512)"),
        ("paper", "Vanilla VQ (1024)"),
        ("missing", "Vanilla VQ (1024)"),
        ("paper", "RVQ (512×2)"),
        ("ours", "RVQ (512×2)"),
        ("paper", "H²VQ (512×2)"),
        ("ours", "H²VQ (512×2)"),
    ]
    assert any("net.num_codes 256 (paper: 512)" in note for note in table.notes)
    assert not any("bl rvq: " in note for note in table.notes)
    assert any("Vanilla VQ (1024)" in note for note in table.notes)

    # Answers without a model stand there once and are never ranked.
    nearest, still = (row for row in table.rows if row.source == "reference")
    assert nearest.label.startswith("nearest") and still.label.startswith("mean pose")
    assert nearest.label.endswith("(bl evaluate)") and still.label.endswith("(bl evaluate)")
    assert texts(nearest)[:3] == ["50.00"] * 3, "better than any tokenizer here"
    assert texts(still)[:3] == ["200.00"] * 3
    assert best(table) == {"bl tokenizer": [0, 1, 2]}


def test_answers_are_of_runs_that_have_a_row_and_equal_ones_stand_once(
    baselines: Make, tmp_path: Path
) -> None:
    stages: dict[str, Any] = {
        "data": {"kind": "synth", "config": {"clips": 8}},
        "fsq": {"kind": "fsq", "config": {"net": {"part": "bodyhand"}}},
        "evaluate": measured("fsq", records.reconstruction(80.0, clips=30)),
    }
    without = records.write_run(tmp_path / "without", stages)
    table = filled("humantomato/7", without, baselines("a"), baselines("b"))
    references = [row.label for row in table.rows if row.source == "reference"]
    assert len(references) == 2 and all(label.endswith(" (a evaluate)") for label in references)
    assert {label.split(" ")[0] for label in table.differences} == {"a", "b"}
    assert not any("without" in note for note in table.notes)


def test_generated_motion_beside_recorded_and_chance(baselines: Make) -> None:
    table = filled("humantomato/13", baselines())
    labels = [row.label for row in table.rows]
    assert labels.index("recorded motion (bl evaluate_gpt)") == labels.index("GT") + 1
    found = {row.label: texts(row) for row in table.rows}
    assert found["bl gpt"] == ["", "", "", "", *["0.500 ± 0.010"] * 3, "3.000 ± 0.200"]
    assert found["bl temos"][-1] == "4.000 ± 0.200"
    assert found["recorded motion (bl evaluate_gpt)"] == ["", "", "", "", *["0.900"] * 3, ""]
    assert found["chance (bl evaluate_gpt)"][4:7] == ["0.031", "0.062", "0.094"]
    assert found[f"{TRAINING} (bl evaluate_gpt)"][-1] == "0.100"
    assert found[f"{STILL} (bl evaluate_gpt)"][-1] == "9.000"
    assert best(table) == {"bl gpt": [4, 5, 6, 7]}
    missing = [(row.method, row.label) for row in table.rows if row.source == "missing"]
    assert ("MLD", "missing in these runs") in missing and ("T2M-GPT", "missing in these runs") in missing
    # What was measured otherwise than in the paper.
    told = {what: (ours, paper) for what, ours, paper in table.differences["bl evaluate_gpt"]}
    assert told["data"] == ("synthetic clips (64)", "Motion-X") and told["clips"] == ("40", None)
    assert told["candidates of TMA-R-Precision (256)"] == ("32", "256") and told["repeats"] == ("2", "5")
    assert told["judged by"][0].startswith("stage tma ") and "split" not in told
    assert told["sampling"] == ("temperature 1.0", None)


def test_only_what_was_measured_alike_is_ranked(baselines: Make, tmp_path: Path) -> None:
    table = filled("humantomato/13", baselines("a"), baselines("b", judge="b"))
    assert set(ours(table)) == {"a gpt", "a temos", "b gpt", "b temos"}
    # Each within its own run, for another TMA judges the other.
    assert best(table) == {"a gpt": [4, 5, 6, 7], "b gpt": [4, 5, 6, 7]}
    metrics = tmp_path / "a" / "stages" / "evaluate_temos" / "metrics.json"
    for changed in ({"lengths": "recorded"}, {"sampling.temperature": 0.0}):
        records.by_text(4.0, 0.25, generator="temos", **changed).write(metrics)
        table = filled("humantomato/13", tmp_path / "a")
        assert best(table) == {}, "listed and not ranked"
        (fact,) = changed
        assert any(note.startswith("Not all measured alike") and fact in note for note in table.notes)
        unlike = (one for found in table.differences.values() for one in found)
        said = [ours for what, ours, _ in unlike if what == "sampling"]
        assert ("temperature 0.0" in said) == ("sampling.temperature" in changed)


def test_equal_figures_are_best_together_or_not_at_all(baselines: Make) -> None:
    run = baselines()
    for name, mpjpe in (("evaluate", 110.0), ("evaluate_vq", 140.0)):
        records.reconstruction(mpjpe).write(run / "stages" / name / "metrics.json")
    assert best(filled("humantomato/7", run)) == {"bl rvq": [0, 1, 2], "bl tokenizer": [0, 1, 2]}
    records.reconstruction(110.0).write(run / "stages" / "evaluate_vq" / "metrics.json")
    assert best(filled("humantomato/7", run)) == {}


@pytest.mark.parametrize(
    ("kind", "path", "hands", "columns"),
    [
        ("shards", "data/Motion_X-shards", True, [0, 1, 2]),
        ("shards", "data/grab", True, [3, 4, 5]),
        ("humanml3d", None, False, [6]),
        ("synth", None, True, [0, 1, 2]),
        ("synth", None, False, [6]),
    ],
)
def test_columns_of_the_data_that_a_run_has(
    kind: str, path: str | None, hands: bool, columns: list[int], tmp_path: Path
) -> None:
    run = records.write_run(
        tmp_path / "run",
        {
            "data": {"kind": kind, "config": {"path": path, "clips": 9}},
            "rvq": {"kind": "rvq", "config": {"net": {"part": "bodyhand", "num_codes": 512, "levels": 2}}},
            "evaluate": measured("rvq", records.reconstruction(60.0, hands=hands)),
        },
    )
    table = filled("humantomato/7", run)
    (cells,) = ours(table).values()
    assert [at for at, text in enumerate(cells) if text] == columns
    named = kind != "synth"
    (unlike,) = table.differences.values()
    assert [what for what, _, _ in unlike] == (["clips"] if named else ["data", "clips"])
    # Errors of bodies without hands are the body's, whatever the file calls them.
    if not hands:
        assert cells[6] == "60.00"


def test_dances_and_texts_of_one_model_share_a_row(tmp_path: Path) -> None:
    made = [records.figure("movement.fid_k", 20.0, 1.0), records.figure("movement.div_m", 5.0)]
    dances = [*made, *(replace(one, row=STILL) for one in made)]
    stages: dict[str, Any] = {
        "data": {"kind": "synth", "config": {"clips": 8}},
        "audio": {"kind": "audio", "inputs": {"data": "data"}},
        "utt": {"kind": "utt", "config": {"net": {"kind": "gru"}}, "inputs": {"audio": "audio"}},
        "gpt": {"kind": "gpt", "config": {"face": False}},
        "ude": {"kind": "ude", "config": {"inject_z": False}, "inputs": {"utt": "utt"}},
        "evaluate": {
            "kind": "evaluate",
            "inputs": {"data": "data", "tma": "utt", "generators.ude": "ude"},
            "figures": records.by_text(1.0, 0.5, generator="ude"),
        },
        "evaluate_dances": {
            "kind": "evaluate_dances",
            "inputs": {"data": "data", "generators.gpt": "gpt", "generators.ude": "ude"},
            "figures": FigureFile("evaluate_dances", tuple(dances), {"made_by": {"generator": "ude"}}),
        },
    }
    table = filled("ude/3", records.write_run(tmp_path / "u", stages))
    assert ours(table) == {"u ude": ["25.00", "50.00", "20.00 ± 1.00", "", "", "5.00"]}
    row = next(row for row in table.rows if row.source == "ours")
    assert row.method == "Ours (gru)"
    (reference,) = (row.label for row in table.rows if row.source == "reference")
    assert reference.endswith(" (u evaluate_dances)")
    with_dmd = filled("ude/5", tmp_path / "u")
    assert not ours(with_dmd)  # its UTT is a GRU


def test_runs_of_one_name_are_told_apart_by_their_paths(baselines: Make) -> None:
    one, other = baselines("x/run"), baselines("y/run")
    labels = ours(filled("humantomato/7", one, other, one))
    assert set(labels) == {
        f"{run} {stage}" for run in ("x/run", "y/run") for stage in ("vq", "rvq", "tokenizer")
    }


def retrieval(**about: Any) -> FigureFile:
    """What the command `retrieval` writes."""
    figures = []
    for name, size in (("A", 40), ("B", 40), ("C", 40), ("D", 32)):
        for key in (f"{name}.{way}/R@{k}" for way in ("t2m", "m2t") for k in (1, 10)):
            k = int(key.partition("@")[2])
            facts = {"split": "test", "candidates": size}
            figures.append(records.figure(key, k / 50, protocol=facts))
            figures.append(records.figure(key, k / size, row=CHANCE, protocol=facts))
    return FigureFile("retrieval", tuple(figures), {"stage": "tma", **about})


def test_retrieval_fills_by_protocol(baselines: Make) -> None:
    run = baselines()
    known = {name: stage.fingerprint for name, stage in finished_records(run).items()}
    for name, file in (("tma", "retrieval.json"), ("temos", "retrieval-temos.json")):
        retrieval(stage=name, fingerprint=known[name]).write(run / file)
    table = filled("humantomato/12", run)
    found = [(row.method, row.label) for row in table.rows if row.source == "ours"]
    assert found == [(f"{p}, {m}", f"bl {m.lower()}") for p in "ABCD" for m in ("TEMOS", "TMA")]
    chance = [texts(row) for row in table.rows if row.label.startswith("chance")]
    assert chance[0] == ["0.025", "", "", "", "0.250"] * 2  # protocol A, among 40
    assert chance[-1] == ["0.031", "", "", "", "0.312"] * 2  # protocol D, among 32
    for about, message in (
        ({"fingerprint": "of another TMA"}, "measured by another 'tma' than is there now"),
        ({"stage": "gone"}, "not a record of motionloom retrieval on this run"),
    ):
        retrieval(**about).write(run / "retrieval.json")
        with pytest.raises(UserError, match=rf"retrieval\.json: {message}"):
            filled("humantomato/12", run)


@pytest.mark.parametrize("number", [20, 21])
def test_retrieval_by_the_evaluator_fills_the_rows_of_guo(number: int, tmp_path: Path) -> None:
    run = records.write_run(tmp_path / "g", {"guo": {"kind": "guo_evaluator"}})
    retrieval(stage="guo", fingerprint="of-guo").write(run / "retrieval.json")
    table = filled(f"humantomato/{number}", run)
    rows = [(row.method, texts(row)[0]) for row in table.rows if row.source == "ours"]
    assert [method.startswith("Guo et al. (2022)") for method, _ in rows] == [True, True]
    assert all(text for _, text in rows)


PAPER_JUDGE = (1, 5, 8, 13, 14, 18, 19, 22)
"""Tables of HumanTOMATO whose FID, Diversity or MModality are of the evaluator's features."""


@pytest.mark.parametrize("number", PAPER_JUDGE)
def test_the_papers_columns_are_judged_by_the_papers_judge(number: int) -> None:
    columns = paper_table(f"humantomato/{number}").columns
    wired = {column.title: column.figure for column in columns if column.figure}
    for title, figure in wired.items():
        for name in ("fid", "diversity", "multimodality"):
            if figure.endswith(f".{name}"):
                assert (figure == f"tma.{name}") == ("TMA" in title), title
    assert any(figure.startswith("tma.") and "of TMA's" in title for title, figure in wired.items())


def test_conditions() -> None:
    tokenizer = StageRecord("t", "vq", 1, "f", Path("t"), {"net": {"num_codes": 512, "ema": True}}, {})
    gpt = StageRecord(
        "g", "gpt", 1, "f", Path("g"), {"prior": "tma", "weight": 0.0}, {"tokenizer": tokenizer}
    )

    def fit(**match: Any) -> bool:
        return fits(StageMatch.parse({"kind": "gpt", **match}, "match"), gpt)

    assert fit() and fit(kind=["vq", "gpt"]) and not fit(kind="vq")
    assert fit(where={"prior": "tma"}) and fit(where={"prior": ["clip", "tma"]})
    assert fit(where={"weight": 0}) and not fit(where={"weight": False})
    assert not fit(where={"weight": {"above": 0}})
    assert not fit(where={"missing": None}) and not fit(where={"prior": {"above": 0}})
    assert fit(inputs={"tma": None}) and not fit(inputs={"tokenizer": None})
    assert not fit(inputs={"tma": {"kind": "tma"}})
    for where, found in (
        ({"net.num_codes": {"below": 1024, "above": 511}}, True), ({"net.num_codes": {"below": 512}}, False),
        ({"net.ema": True}, True), ({"net.ema": 1}, False),
    ):  # fmt: skip
        assert fit(inputs={"tokenizer": {"kind": "vq", "where": where}}) is found


def test_what_a_run_lacks_is_one_sentence(baselines: Make, tmp_path: Path) -> None:
    run = baselines()
    with pytest.raises(UserError, match=re.escape(f"make one: motionloom retrieval {run}")):
        filled("humantomato/10", run)
    with pytest.raises(UserError, match="evaluate_dances: motionloom run"):
        filled("ude/2", run)
    bare = records.write_run(tmp_path / "bare", {"evaluate": {"kind": "evaluate", "finished": False}})
    with pytest.raises(UserError, match="bare: "):
        filled("humantomato/7", bare)
    with pytest.raises(UserError, match="nowhere: "):
        filled("humantomato/7", tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"metrics\.json: not valid JSON"),
        ("[]", r"metrics\.json: holds no JSON object"),
        ('{"version": 0}', r"metrics\.json: version 0, whose figures meant something else"),
        ('{"version": 1, "figures": 3}', r"metrics\.json: not as an evaluation writes it"),
        (
            '{"version": 1, "kind": "evaluate", "about": {}, "protocol": {"g": {}}, '
            '"figures": [{"name": "x", "group": "g", "value": NaN}]}',
            r"metrics\.json: figure 'x' is no number",
        ),
    ],
)
def test_a_broken_file_is_one_sentence(content: str, message: str, baselines: Make) -> None:
    run = baselines()
    path = run / "stages" / "evaluate" / "metrics.json"
    path.write_text(content)
    with pytest.raises(UserError, match=message):
        filled("humantomato/7", run)


def test_figures_of_a_model_that_is_made_anew_are_refused(baselines: Make) -> None:
    run = baselines()
    path = run / "stages" / "vq" / "artifact.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fingerprint": "another"}))
    with pytest.raises(UserError, match=r"'evaluate_vq' .*another 'vq'"):
        filled("humantomato/7", run)
