"""Charts and marked cells as HTML: right numbers, readable names, nothing unescaped."""

from __future__ import annotations

import json
import re
from html import unescape

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.pipeline.render.charts import Line, curve_label, histogram, line_chart
from motionloom.pipeline.render.page import Cell, Page

NASTY = '<b onclick="x">&'


def test_figures_of_a_log_have_names_for_people() -> None:
    for key, words in {
        "tokens_ce": "tokens cross-entropy",
        "tokens_accuracy_left_hand": "tokens accuracy: left hand",
        "dead_code": "dead codes",
        "resets_level12": "reset codes: level 12",
        "rec_motion": "reconstructed motion",
        "my_own_figure": "my own figure",
    }.items():
        assert curve_label(key) == words


def test_cells_and_folds_of_a_page() -> None:
    page = Page("t").add_table(
        ["", Cell(NASTY, colour=3)], [["a", Cell(NASTY, best=True)], ["b", Cell("2", soft=True)]], pinned=True
    )
    with page.folded(NASTY):
        for title in ("two", "three"):
            page.add_plot([Line("x", [1, 2], [1, 2])], title)
    body = page.html().split("<main>")[1].split("</main>")[0]
    assert NASTY not in body and body.count("★") == 1 and '<i class="key s3">' in body
    assert body.count('<div class="plots">') == 1
    assert body.index("<details") < body.index("three") < body.index("</details>")


def test_curves_take_the_colour_they_are_given() -> None:
    html = line_chart([Line("a", [0, 1], [0, 1], colour=5), Line("b", [0, 1], [1, 0], dashed=True, colour=5)])
    assert re.findall(r'polyline class="curve (s\d)"', html) == ["s5", "s5"]
    assert re.findall(r'class="key (s\d)', html) == ["s5", "s5"]
    assert re.findall(r"curve (s\d)", line_chart([Line("a", [0, 1], [0, 1])] * 2)) == ["s0", "s1"]


def test_line_chart_keeps_spikes_and_drops_what_is_not_finite() -> None:
    y = np.ones(5000)
    y[1234], y[77] = 9.0, np.nan
    svg = line_chart(
        [Line("train", np.arange(5000), y), Line("val", [0, 5000], [2, 1], dashed=True)], y_label="loss"
    )
    hover = json.loads(unescape(re.search(r'data-hover="([^"]*)"', svg)[1]))
    train = hover["lines"][0]
    assert 9.0 in [v for _, v in train["values"]] and len(train["values"]) <= 402
    assert "nan" not in svg.lower()
    assert svg.count("<polyline") == 2 and svg.count("stroke-dasharray") == 1
    inside = np.array(train["at"])
    assert (inside >= 0).all() and (inside <= [640, 320]).all()


@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=20))
@settings(max_examples=80, deadline=None)
def test_charts_draw_any_numbers(values: list[float]) -> None:
    svg = line_chart([Line("a", range(len(values)), values)])
    assert svg.startswith("<svg") and "inf" not in svg and "nan" not in svg
    counts = np.abs(values)
    assert histogram({"n": counts}, (0, len(values))).count("<rect") == (len(values) if counts.any() else 0)


def test_charts_without_data_say_so() -> None:
    assert "no data" in line_chart([]) and "no data" in line_chart([Line("a", [1], [np.nan])])
    assert "no data" in histogram({}, (0, 1))
    assert histogram({"uses": [0] * 20 + [3]}, (0, 21)).count('class="dead"') == 20
    with pytest.raises(ValueError, match="line 'a'"):
        line_chart([Line("a", [1, 2], [1])])
