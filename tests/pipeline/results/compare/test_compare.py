"""Several runs compared: what differs, who is best where, what is missing, and that nothing is trusted."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from run_records import log, metrics
from run_records import write_compared as write_run

from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.figures import STILL
from motionloom.pipeline.results.compare.command import compare_runs, missing_lines
from motionloom.pipeline.results.compare.runs import (
    ABSENT,
    ComparedTable,
    compared_tables,
    open_runs,
    setting_differences,
)

QUIET = Console(quiet=True)
NASTY = "<img src=x onerror='window.hacked=1'>"


def tables_of(*folders: Path) -> dict[str, ComparedTable]:
    """By their title."""
    return {table.title: table for table in compared_tables(open_runs(folders))}


def best_of(table: ComparedTable) -> dict[str, dict[str, bool]]:
    return {row.run.label: dict(row.best) for row in table.rows}


def test_only_what_differs_is_listed_stage_by_stage(tmp_path: Path) -> None:
    one = write_run(tmp_path / "one")
    changed = {"kind": "h2vq", "train": {"steps": 100}, "net": {"width": 16, "ema": 0.9}}
    two = write_run(tmp_path / "two", seed=8, stages={"tokenizer": changed, "tma": {"kind": "tma", "a": 1}})
    found = {d.stage: d for d in setting_differences(open_runs([one, two]))}
    assert set(found) == {"", "tokenizer", "tma"}
    assert found[""].differences == {"seed": (7, 8)}
    assert found["tokenizer"].differences == {"net.width": (8, 16), "net.ema": (ABSENT, 0.9)}
    assert found["tma"].missing == ("one",) and found["tma"].differences == {}


def test_a_finished_stage_has_the_settings_that_made_it(tmp_path: Path) -> None:
    one, two = write_run(tmp_path / "one"), write_run(tmp_path / "two")
    recipe = two / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace("width: 8", "width: 99"))
    assert setting_differences(open_runs([one, two])) == []
    (two / "stages/tokenizer/artifact.json").unlink()
    (stage,) = setting_differences(open_runs([one, two]))
    assert stage.differences == {"net.width": (8, 99)}


def test_best_is_marked_among_runs_measured_alike(tmp_path: Path) -> None:
    low = write_run(tmp_path / "low", figures=metrics(mpjpe=40.0, r1=0.40))
    high = write_run(tmp_path / "high", seed=8, figures=metrics(mpjpe=60.0, r1=0.60))
    tables = tables_of(low, high)
    table = tables["reconstruction"]
    assert best_of(table) == {"low": {"reconstruction.mpjpe": True}, "high": {}}, "bit/s is no merit"
    assert table.difference == ""
    assert [(r.title, r.runs, r.figures["reconstruction.mpjpe"].value) for r in table.references] == [
        ("nearest training clip", (), 80.0),
        ("mean pose, still", (), 200.0),
    ]
    assert best_of(tables["precision"]) == {"low": {}, "high": {"tma.t2m_r1": True}}
    assert "tma.matching_score" not in best_of(tables["precision"])["low"], "equal: nobody is best"
    assert best_of(tables["spread"]) == {"low": {}, "high": {}}, "Diversity is not ranked, FID is equal"


def test_overlapping_intervals_leave_doubt(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / name, figures=metrics(r1=r1, half=0.06))
        for name, r1 in (("a", 0.4), ("b", 0.5), ("c", 0.2))
    ]
    assert best_of(tables_of(*runs)["precision"])["b"] == {"tma.t2m_r1": False}
    metrics(r1=0.9, half=0.06).write(runs[1] / "stages/evaluate/metrics.json")
    assert best_of(tables_of(*runs)["precision"])["b"] == {"tma.t2m_r1": True}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"repeats": 5}, "repeats (one: 2; two: 5)"),
        ({"lengths": "recorded"}, "lengths (one: free; two: recorded)"),
        ({"clips_sha256": "other"}, "different clips"),
        ({"judge": "other"}, "different judges"),
        ({"sampling.temperature": 0.0}, "sampling.temperature (one: 1.0; two: 0.0)"),
    ],
)
def test_another_protocol_is_said_and_not_ranked(change: dict[str, Any], words: str, tmp_path: Path) -> None:
    one = write_run(tmp_path / "one", figures=metrics(mpjpe=40.0, r1=0.4))
    two = write_run(tmp_path / "two", figures=metrics(mpjpe=60.0, r1=0.6, **change))
    tables = tables_of(one, two)
    assert best_of(tables["precision"]) == {"one": {}, "two": {}}
    assert words in tables["precision"].difference
    assert best_of(tables["reconstruction"])["one"] == {"reconstruction.mpjpe": True}, (
        "which it does not concern"
    )
    three = write_run(tmp_path / "three", figures=metrics(mpjpe=60.0, r1=0.7))
    table = tables_of(one, two, three)["precision"]
    assert best_of(table) == {"one": {}, "two": {}, "three": {"tma.t2m_r1": True}}
    assert [row.protocol for row in table.rows] == [0, 1, 0]


def test_references_that_differ_say_whose_they_are(tmp_path: Path) -> None:
    known = metrics()
    still = [one if one.row != STILL else replace(one, value=300.0) for one in known.figures]
    other = replace(known, figures=tuple(still))
    one, two = write_run(tmp_path / "one", figures=metrics()), write_run(tmp_path / "two", figures=other)
    rows = tables_of(one, two)["reconstruction"].references
    assert [(row.title, row.runs) for row in rows] == [
        ("nearest training clip", ()),
        ("mean pose, still", ("one",)),
        ("mean pose, still", ("two",)),
    ]


def test_unfinished_runs_show_what_they_have(tmp_path: Path) -> None:
    done = write_run(tmp_path / "done", logs={"tokenizer": log(100)}, figures=metrics())
    going = write_run(tmp_path / "going", finished=("data",), logs={"tokenizer": log(40, 2.0)})
    runs = open_runs([done, going])
    assert missing_lines(runs[0]) == []
    tokenizer, evaluate = missing_lines(runs[1])
    assert tokenizer.startswith("tokenizer: ") and "step 40 of 100" in tokenizer
    assert evaluate.startswith("evaluate: not run")
    html = unescape(compare_runs([done, going], tmp_path / "page.html", console=QUIET).read_text())
    curves = re.findall(r'"name":"((?:done|going) \(\w+\))".*?"values":.*?\[(\d+\.0),[^\]]*\]\]', html)
    ends = [
        (f"{run} ({kind})", end) for run, end in (("done", 100), ("going", 40)) for kind in ("train", "val")
    ]
    assert [(name, float(step)) for name, step in curves[:4]] == ends
    assert f"going – {tokenizer}; {evaluate}" in html
    assert "3 of 3" in html and "1 of 3" in html
    assert "2 min 03 s" not in html and "3 min 03 s" in html and "an abacus" in html


def test_figures_of_a_stage_whose_input_was_made_anew_are_outdated(tmp_path: Path) -> None:
    one, two = (write_run(tmp_path / name, figures=metrics()) for name in ("one", "two"))
    path = two / "stages/data/artifact.json"
    path.write_text(path.read_text().replace('"fingerprint": "of-data"', '"fingerprint": "new"'))
    runs = open_runs([one, two])
    for name, line in zip(("tokenizer", "evaluate"), missing_lines(runs[1]), strict=True):
        assert line.startswith(f"{name}: outdated: 'data' ")
    assert [row.run.label for row in compared_tables(runs)[0].rows] == ["one"]


def test_mistakes_are_one_sentence(tmp_path: Path) -> None:
    good, other = write_run(tmp_path / "good", figures=metrics()), write_run(tmp_path / "other")
    with pytest.raises(UserError, match="two runs"):
        open_runs([good])
    with pytest.raises(UserError, match=r"9 runs: .* 8"):
        open_runs([good] * 9)
    with pytest.raises(UserError, match="is named twice"):
        open_runs([good, tmp_path / "other" / ".." / "good"])
    with pytest.raises(UserError, match="nothing: "):
        open_runs([good, tmp_path / "nothing"])
    with pytest.raises(UserError, match="folder"):
        compare_runs([good, other], tmp_path, console=QUIET)
    out = tmp_path / "page.html"
    for name, text, words in (
        ("stages/evaluate/metrics.json", "{", "metrics.json: not valid JSON"),
        ("stages/evaluate/metrics.json", "[]", "metrics.json: holds no JSON object"),
        ("stages/tokenizer/metrics.jsonl", '{"step": 1}\n{"st', "metrics.jsonl: not a training log"),
        ("stages/tokenizer/metrics.jsonl", "7\n", "metrics.jsonl: line 1 is no row"),
        ("stages/tokenizer/artifact.json", "nonsense", "artifact.json: not valid JSON"),
        ("recipe.yaml", "stages: 5", "recipe.yaml: holds no stages"),
    ):
        path = good / name
        before = path.read_text() if path.is_file() else None
        path.write_text(text)
        with pytest.raises(UserError, match=words) as found:
            compare_runs([good, other], out, console=QUIET)
        assert "\n" not in str(found.value)
        path.unlink() if before is None else path.write_text(before)
    assert not out.exists()
    compare_runs([good, other], out, console=QUIET)
    assert out.is_file()


def test_names_never_become_html(tmp_path: Path) -> None:
    entry = {"kind": NASTY, "train": {"steps": 20}, NASTY: NASTY}
    runs = [
        write_run(
            tmp_path / f"{number}{NASTY}",
            stages={NASTY: {**entry, "n": number}},
            finished=(),
            logs={"tokenizer": [{"step": 1, f"train/{NASTY}": 1.0}, {"step": 2, f"train/{NASTY}": 2.0}]},
        )
        for number in (1, 2)
    ]
    html = compare_runs(runs, tmp_path / "page.html", console=QUIET).read_text()
    assert "<img" not in html and html.count("&lt;img") > 5


def test_the_command(tmp_path: Path, call: Callable[..., Any]) -> None:
    one = write_run(tmp_path / "one", figures=metrics(mpjpe=40.0), logs={"tokenizer": log(100)})
    two = write_run(tmp_path / "two", seed=8, finished=("data",), logs={"tokenizer": [*log(20)]})
    (two / "stages/tokenizer/metrics.jsonl").write_text('{"step": 10, "train/loss": NaN}\n')
    done = call("compare", one, two, "-o", tmp_path / "a/page.html")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == str(tmp_path / "a/page.html")
    assert re.search("two: .*tokenizer: .*10 of 100; evaluate", done.out)
