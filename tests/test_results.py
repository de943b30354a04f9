"""`docs/results.md` is what its records say."""

from __future__ import annotations

import json
import re

import pytest

from tests.test_benchmarks import FOLDER, loaded


def test_the_page_is_made_of_its_records(monkeypatch: pytest.MonkeyPatch) -> None:
    results = loaded(FOLDER / "results.py", monkeypatch)
    assert results.PAGE.read_text() == results.rendered(), "run python benchmarks/results.py"


def test_no_figure_is_typed_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    results = loaded(FOLDER / "results.py", monkeypatch)
    words = results.TABLE.sub("", results.PAGE.read_text())
    words = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)|BY-NC\s4\.0", "", words, flags=re.DOTALL)
    assert not re.findall(r"\d+\.\d+|\d ?%|±.?\d|\d ?mm\b", words)


def test_several_seeds_are_a_mean_with_its_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    results = loaded(FOLDER / "results.py", monkeypatch)
    column = {"title": "pose, mm", "figure": "pose", "digits": 1, "scale": 1.0}
    drawn = {"clips": 4, "sampling.top_k": 3}
    one = {"title": "a", "cells": {"pose": [1.0, 2.0, 3.0]}, "seeds": [7, 8, 9], "protocol": {"clips": 4}}
    two = {"title": "b", "cells": {"pose": [2.0]}, "seeds": [7], "protocol": drawn | {"clips": 5}}
    three = {"title": "c", "cells": {"pose": [9.0]}, "seeds": [], "protocol": drawn}
    record = {"measured": "2026-01-02", "columns": [column], "rows": [one, two, three]}
    page = results.page("Words\n\n<!--t-->\n| old | 1.0 |\n\n*Measured before.*\n\nMore", {"t": record})
    # Student's t of three values: 4.303 deviations / sqrt(3).
    assert "| a | 2.0 ± 2.5 |" in page and "| b (1 seed) | 2.0 |" in page
    assert "*Measured 2026-01-02: a and c: clips 4; b: clips 5, top_k 3.*" in page
    assert "old" not in page and page.endswith("\n\nMore") and results.page(page, {"t": record}) == page


def test_the_first_page_says_what_one_draw_gets() -> None:
    card = json.loads((FOLDER.parent / "models/pretrained/synthetic/card.json").read_text(encoding="utf-8"))
    best, one = (card[kind]["as in training"]["held out"]["whole"] for kind in ("right", "single draws"))
    words = " ".join((FOLDER.parent / "README.md").read_text(encoding="utf-8").split())
    assert f"are then right in {100 * best:.1f} % of clips, with one draw in {100 * one:.1f} %" in words
