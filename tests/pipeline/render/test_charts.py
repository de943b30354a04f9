"""The report's charts: every number in its place, any number accepted."""

from __future__ import annotations

import json
import re
from html import unescape

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.pipeline.render.charts import Line, bar_chart, line_chart


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
    assert (
        inside[:, 0].min() >= 0
        and inside[:, 0].max() <= 640
        and inside[:, 1].min() >= 0
        and inside[:, 1].max() <= 320
    )


@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=20))
@settings(max_examples=80, deadline=None)
def test_charts_draw_any_numbers(values: list[float]) -> None:
    for log in (False, True):
        svg = line_chart([Line("a", range(len(values)), values)], log_y=log)
        assert svg.startswith("<svg") and "inf" not in svg and "nan" not in svg
    assert bar_chart(values).count("<rect") == len(values)


def test_charts_without_data_say_so() -> None:
    assert "no data" in line_chart([]) and "no data" in line_chart([Line("a", [1], [np.nan])])
    assert "no data" in bar_chart([])
    assert bar_chart([0] * 20 + [3]).count('class="dead"') == 20
    with pytest.raises(ValueError, match="line 'a'"):
        line_chart([Line("a", [1, 2], [1])])
