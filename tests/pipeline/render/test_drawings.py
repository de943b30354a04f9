"""Charts, bodies, matrices and marked cells as HTML: right numbers, readable names, nothing unescaped."""

from __future__ import annotations

import json
import re
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.body_map import Scale, body_map
from motionloom.pipeline.render.charts import Line, bar_chart, line_chart, matrix_table
from motionloom.pipeline.render.labels import curve_label, joint_label
from motionloom.pipeline.render.page import Cell, Page

NASTY = '<b onclick="x">&'
WHOLE, BODY = Skeleton.named("smplx52"), Skeleton.named("smpl22")


class Balanced(HTMLParser):
    """Fails on a tag that is closed and not open."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: object) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_joints_and_figures_of_a_log_have_names_for_people() -> None:
    for joint, words in {
        "left_index2": "left index finger, middle joint",
        "right_pinky1": "right little finger, knuckle",
        "left_thumb3": "left thumb, last joint",
        "right_foot": "right ball of the foot",
        "left_collar": "left collarbone",
        "tail_base": "tail base",
    }.items():
        assert joint_label(joint) == words
    labels = [joint_label(joint) for joint in WHOLE.joints]
    assert len(set(labels)) == 52 and not any("_" in label for label in labels)
    for key, words in {
        "tokens_ce": "tokens cross-entropy",
        "tokens_accuracy_left_hand": "tokens accuracy: left hand",
        "dead_code": "dead codes",
        "resets_level12": "reset codes: level 12",
        "rec_motion": "reconstructed motion",
        "my_own_figure": "my own figure",
    }.items():
        assert curve_label(key) == words


def test_every_joint_is_drawn_with_its_error() -> None:
    errors, hands = np.linspace(0, 120, 52).tolist(), np.linspace(5, 9, 30).tolist()
    html = body_map(WHOLE, errors, hands, NASTY)
    Balanced(html)
    assert "<b" not in html.replace("<body", "")
    tips = dict(re.findall(r"<title>([^:<]+): ([\d.]+) mm</title>", html))
    for joint, error in zip(WHOLE.joints, [*errors[:22], *hands], strict=True):
        assert tips[joint_label(joint)] == f"{error:.1f}"
    assert html.count("<svg") == 2 and "50 mm" in html and "10 mm" in html
    assert body_map(BODY, errors[:22], (), "t").count("<svg") == 1
    places = [float(x) for x in re.findall(r'<(?:circle|text)[^>]* (?:c?x)="([-\d.]+)"', html)]
    assert min(places) >= 0 and max(places) <= 400


def test_left_is_on_the_right_as_one_sees_a_person() -> None:
    html = body_map(BODY, [1.0] * 22, (), "t")
    place = {
        name: float(re.search(rf'x="([\d.]+)"[^>]*>{name}<', html).group(1))  # type: ignore[union-attr]
        for name in ("left hand", "right hand", "left foot", "right foot")
    }
    assert place["right hand"] < place["right foot"] < 200 < place["left foot"] < place["left hand"]


def test_colours_run_from_light_to_dark() -> None:
    scale = Scale.for_errors([3.0, 47.0, float("nan")])
    assert scale.top == 50.0 and Scale.for_errors([]).top == 1.0
    light = [sum(int(scale.colour(e)[k : k + 2], 16) for k in (1, 3, 5)) for e in (0, 10, 20, 30, 40, 50)]
    assert light == sorted(light, reverse=True) and len(set(light)) == 6
    assert scale.colour(99.0) == scale.colour(50.0)
    with pytest.raises(UserError, match="3 errors for the 22 joints of smpl22"):
        body_map(BODY, [1.0] * 3)
    with pytest.raises(UserError, match="4 errors of fingers for 30 joints"):
        body_map(WHOLE, [1.0] * 52, [1.0] * 4)


def test_a_matrix_says_counts_and_shares() -> None:
    html = matrix_table(["walk", NASTY], ["walk", NASTY, "else"], [[3, 1, 0], [0, 0, 2]], title=NASTY)
    Balanced(html)
    assert "<b" not in html.replace("<body", "").replace("<tbody", "") and "&lt;b" in html
    assert re.findall(r'<td class="(\w+)"(?: style="--share:(\d+)%")?[^>]*>([^<]+)', html) == [
        ("right", "75", "3"),
        ("wrong", "25", "1"),
        ("none", "", "·"),
        ("none", "", "·"),
        ("none", "", "·"),
        ("wrong", "100", "2"),
    ]
    with pytest.raises(UserError, match="1 rows and 2 columns do not fit its counts"):
        matrix_table(["a"], ["a", "b"], [[1]], title="t")


def test_cells_and_folds_of_a_page() -> None:
    page = Page("t").add_table(
        ["", Cell(NASTY, colour=3)], [["a", Cell(NASTY, best=True)], ["b", Cell("2", soft=True)]], pinned=True
    )
    with page.folded(NASTY):
        page.add_matrix(["a"], ["a"], [[1]], "one").add_matrix(["a"], ["a"], [[1]], "two")
        page.add_plot([Line("x", [1, 2], [1, 2])], "three")
    body = page.html().split("<main>")[1].split("</main>")[0]
    assert NASTY not in body and body.count("★") == 1 and '<i class="key s3">' in body
    assert body.count('<div class="matrices">') == 1 and body.count('<div class="plots">') == 1
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
