"""Every script of `benchmarks/`, and `docs/pictures.py`, can be loaded; docs/results.md has their records."""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import synthesize
from motionloom.pipeline.evaluation.figures import NEAREST_LABELS, NEAREST_WORDS
from motionloom.pipeline.evaluation.reference_baselines import by_nearest_labels
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.runs.recipe import load_recipe

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = [
    path for path in sorted(FOLDER.glob("*.py")) if path.name not in ("bench.py", "charted.py", "rows.py")
]
SCRIPTS.append(FOLDER.parent / "docs" / "pictures.py")


DOCS = sorted(page for depth in ("*", "docs/*", "models/*/*/*") for page in FOLDER.parent.glob(f"{depth}.md"))
COMMANDS = sorted(
    {
        found.strip("` ").removeprefix("python benchmarks/")
        for page in DOCS
        for found in re.findall(
            r"^python benchmarks/.*|`python benchmarks/\S* [^`\n]*`", page.read_text(), re.MULTILINE
        )
    }
)
"""Every command of a benchmark that the documents give, without `python benchmarks/`."""


def loaded(script: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(script.parent))  # some share functions
    spec = importlib.util.spec_from_file_location(f"benchmark_{script.stem}", script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_benchmark_can_be_loaded(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = loaded(script, monkeypatch)
    assert callable(module.main) and module.__doc__
    assert f"{script.parent.name}/{script.name}" in module.__doc__, "its command stands in its docstring"


@pytest.mark.parametrize("clips", [1000, 4000])
def test_what_grows_with_a_set_grows_by_what_it_must(
    clips: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    growth = loaded(FOLDER / "growth.py", monkeypatch)
    monkeypatch.setattr(growth, "SHARD", 16)
    monkeypatch.setattr(growth, "BATCH", 32)
    found = growth.counts(growth.made(tmp_path, clips))
    assert not {name: value for name, value in found.items() if value > growth.MOST[name]}


def test_a_models_card_is_measured_on_the_clips_that_a_run_would_hold_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Made one by one, without shards: the test split's motions, captions and truths."""
    card = loaded(FOLDER / "model_card.py", monkeypatch)
    text = """
name: held
seed: 5
stages:
  data:
    kind: synth
    clips: 30
    wordings: many
    test_fraction: 0.2
    hold_out: [{action: walk}]
"""
    (tmp_path / "held.yaml").write_text(text)
    recipe = load_recipe(tmp_path / "held.yaml")
    made, config = card.test_clips(recipe, 1000)
    assert config.seed == 5
    synthesize(config, tmp_path / "shards", progress=False)
    dataset = ShardDataset.open(tmp_path / "shards", "test")
    wanted = {truth.id: truth for truth in (truth_of(dataset, row) for row in range(len(dataset)))}
    assert {truth.id for truth in made} == set(wanted) and len(made) >= 8
    for truth in made:
        for name, value in vars(wanted[truth.id]).items():
            np.testing.assert_array_equal(getattr(truth, name), value, err_msg=name)
    train = ShardDataset.open(tmp_path / "shards", "train")
    found = card.lookups(made, config)
    for own, theirs, wanted_of in zip(
        found[NEAREST_LABELS], by_nearest_labels(train, made), made, strict=True
    ):
        said = {k: v for k, v in wanted_of.truth.items() if v is not None}
        alike = [sum(one.truth.get(k) == v for k, v in said.items()) for one in (own, theirs)]
        assert alike[0] == alike[1]
    captions = {clip.caption for clip in (truth_of(train, row) for row in range(len(train)))}
    assert {clip.caption for clip in found[NEAREST_WORDS]} <= captions
    few, _ = card.test_clips(recipe, 3)
    assert [truth.id for truth in few] == [truth.id for truth in made[:3]]


def test_figures_of_a_card_are_compared_where_they_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    card = loaded(FOLDER / "model_card.py", monkeypatch)
    right = {"words": {"other": {"all": 0.5}}}
    figures = {"clips": 2, "seed": 0, "sampling": {}, "recipe": "r", "right": right}
    assert card.compared({}, figures).startswith("no card")
    assert card.compared(figures, figures) == "all 1 shares as on the card"
    assert card.compared({**figures, "seed": 1}, figures).startswith("not comparable")
    off = {**figures, "right": {"words": {"other": {"all": 0.75}}}}
    assert card.compared(figures, off) == "1 shares, at most 25.0 points from the card (all, words, other)"


class ReadError(Exception):
    """The arguments have been read."""


@pytest.mark.parametrize("command", COMMANDS)
def test_the_documents_commands_have_options_that_exist(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Arguments are read and nothing is measured; whole words, since argparse takes beginnings for them."""
    name, *words = shlex.split(command)
    init, parse = argparse.ArgumentParser.__init__, argparse.ArgumentParser.parse_args

    def exact(self: argparse.ArgumentParser, *given: Any, **options: Any) -> None:
        init(self, *given, **{**options, "allow_abbrev": False})

    def read(self: argparse.ArgumentParser, *given: Any, **options: Any) -> None:
        parse(self, *given, **options)
        raise ReadError

    module = loaded(FOLDER / name, monkeypatch)
    monkeypatch.setattr(argparse.ArgumentParser, "__init__", exact)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", read)
    monkeypatch.setattr(sys, "argv", [name, *words])
    try:
        module.main()
    except ReadError:
        return
    except SystemExit:
        pytest.fail(capsys.readouterr().err)


def test_the_page_is_made_of_its_records(monkeypatch: pytest.MonkeyPatch) -> None:
    results = loaded(FOLDER / "results.py", monkeypatch)
    assert results.PAGE.read_text() == results.rendered(), "run python benchmarks/results.py"


def test_titles_say_what_records_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates in titles and variants in names of rows are the record's; each drawn row says how it was."""
    results = loaded(FOLDER / "results.py", monkeypatch)
    for name, table in results.TABLES.items():
        record = json.loads((results.RECORDS / f"{name}.json").read_text(encoding="utf-8"))
        assert [one["title"] for one in record["columns"]] == [column.title for column in table.columns]
        assert not any(re.search(r"among \d|\(\d", column.title) for column in table.columns)
        assert "not recorded" not in results.table_of(record).splitlines()[0], name
        for row in record["rows"]:
            asked = {one.figure for one in table.columns if "{candidates}" in one.title} & row["cells"].keys()
            assert asked <= row.get("candidates", {}).keys(), (name, row["title"])
            if name.startswith(("rivals", "mocap")) and row["seeds"]:
                assert {"steps", "repeats", "clips"} <= row["protocol"].keys(), (name, row["title"])
                assert row["protocol"]["steps"] != "not recorded", (name, row["title"])
                assert "lengths" in row["protocol"] or name == "rivals_ude_music"
    column, run = {"title": "R ({candidates})", "figure": "r", "digits": 1, "scale": 1.0}, {"title": "MDM"}
    runs = [
        {**run, "cells": {"r": [value]}, "seeds": [seed], "variant": ["norm pre"], "candidates": {"r": 32},
         "protocol": {"clips": clips}} for value, seed, clips in ((1.0, 7, 97), (3.0, 1, 95))
    ]  # fmt: skip
    page = results.table_of({"columns": [column], "rows": [results.merged(runs)]})
    assert (
        "| R (32) |" in page
        and "| MDM [norm pre] (2 seeds) | 1.0 / 3.0 |" in page
        and "clips 97 and 95" in page
    )


def test_several_seeds_are_a_mean_with_its_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    results = loaded(FOLDER / "results.py", monkeypatch)
    column = {"title": "pose, mm", "figure": "pose", "digits": 1, "scale": 1.0}
    drawn = {"clips": 4, "sampling.top_k": 3}
    one = {"title": "a", "cells": {"pose": [1.0, 2.0, 3.0]}, "seeds": [7, 8, 9], "protocol": {"clips": 4}}
    two = {"title": "b", "cells": {"pose": [2.0]}, "seeds": [7], "protocol": drawn | {"clips": 5}}
    three = {"title": "c", "cells": {"pose": [9.0]}, "seeds": [], "protocol": drawn}
    record = {"measured": "2026-01-02", "code": {}, "columns": [column], "rows": [one, two, three]}
    page = results.page("Words\n\n<!--t-->\n| old | 1.0 |\n\n*Measured before.*\n\nMore", {"t": record})
    # Student's t of three values: 4.303 deviations / sqrt(3).
    assert "| a | 2.0 ± 2.5 |" in page and "| b (1 seed) | 2.0 |" in page
    assert "*Measured 2026-01-02: a and c: clips 4; b: clips 5, top_k 3.*" in page
    assert "old" not in page and page.endswith("\n\nMore") and results.page(page, {"t": record}) == page


def test_rows_of_older_code_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    results = loaded(FOLDER / "results.py", monkeypatch)
    bench = sys.modules["bench"]
    row = {"cells": {"r": [1.0]}, "seeds": [7]}
    now, then = ({"mdm": bench._version("mdm"), "gone": 0}, {"mdm": 0, "text": bench._version("text")})
    rows = [{**row, "title": "a", "code": now}, {**row, "title": "b", "code": then}, {**row, "title": "c"}]
    own = bench.settings_now("baselines-tiny") | {"mdm": bench.settings_digest("mdm", {"min_frames": 9})}
    rows.append({**row, "title": "d", "code": now, "recipe": "baselines-tiny", "settings": own})
    column = {"title": "R", "figure": "r", "digits": 1, "scale": 1.0}
    record = {"commit": "1234567", "columns": [column], "rows": rows}
    now_is = f"mdm 0, now {bench._version('mdm')}"
    assert bench.older_rows(record) == {"b": now_is, "c": "of commit 1234567", "d": "settings of mdm"}
    assert f"*Of older code: b ({now_is}); c (of commit 1234567);" in results.table_of(record)


OLDER = {"dmd", "negative_filter", "rivals"}
"""Records with rows of older code, which the page says: to be measured again, or deleted."""


def test_no_other_row_is_of_older_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kind whose version goes up makes the rows that measured it old: measure them again, or list them."""
    records = loaded(FOLDER / "results.py", monkeypatch).read_records()
    older = {name: found for name, one in records.items() if (found := sys.modules["bench"].older_rows(one))}
    assert older.keys() <= OLDER, older


def test_the_first_page_says_what_one_draw_gets() -> None:
    card = json.loads((FOLDER.parent / "models/pretrained/synthetic/card.json").read_text(encoding="utf-8"))
    best, one = (card[kind]["as in training"]["held out"]["whole"] for kind in ("right", "single draws"))
    words = " ".join((FOLDER.parent / "README.md").read_text(encoding="utf-8").split())
    assert f"are then right in {100 * best:.1f} % of clips, with one draw in {100 * one:.1f} %" in words
