"""The list of figures: intervals, files, and that a new metric is one function and one line."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation import clip_metrics
from motionloom.pipeline.evaluation.clip_metrics import ClipMetric, Performance, clip_figures, measure_clip
from motionloom.pipeline.evaluation.estimate import RESAMPLES, estimate, row_estimates, weighted
from motionloom.pipeline.evaluation.figures import (
    CHANCE,
    MODEL,
    RECORDED,
    Figure,
    FigureFile,
    Metric,
    figure_tables,
    print_summary,
)
from motionloom.pipeline.evaluation.movement import movement_figures

TRIALS = 1500


def covered(draw: Callable[[np.random.Generator], np.ndarray], true: float) -> float:
    """How often an interval has the true mean."""
    rng, hits = np.random.default_rng(0), 0
    for _ in range(TRIALS):
        found = estimate(draw(rng))
        assert found.interval is not None
        hits += abs(found.value - true) <= found.interval
    return hits / TRIALS


@pytest.mark.parametrize("repeats", [3, 20])
def test_intervals_over_repeats_hold_what_they_say(repeats: int) -> None:
    """Student's t: with 1.96 three repeats would cover 81 %."""
    assert 0.93 < covered(lambda rng: rng.normal(1.0, 2.0, repeats), 1.0) < 0.97


@pytest.mark.parametrize("repeats", [1, 3])
def test_intervals_over_clips_hold_what_they_say(repeats: int) -> None:
    """100 clips that differ more than the repeats of one clip do: repeats alone say nothing of them."""

    def draw(rng: np.random.Generator) -> np.ndarray:
        return rng.normal(0.5, 1.0, 100) + rng.normal(0.0, 0.3, (repeats, 100))

    assert 0.93 < covered(draw, 0.5) < 0.97


def test_a_bootstrap_by_hand() -> None:
    """Ratios of sums, clips without a value, repeats of a clip together."""
    values = np.array([[1.0, 4.0, np.nan, 2.0], [3.0, 4.0, 5.0, np.nan]])
    weights = np.array([[1.0, 2.0, 1.0, 1.0], [1.0, 2.0, 3.0, 1.0]])
    found = estimate(values, weights)
    total, each = np.array([4.0, 16.0, 15.0, 2.0]), np.array([2.0, 4.0, 3.0, 1.0])
    assert found.value == pytest.approx(37 / 10) and found.over == "clips"
    counts = np.random.default_rng(4).multinomial(4, [0.25] * 4, size=RESAMPLES)
    means = [(count @ total) / (count @ each) for count in counts]
    assert found.interval == pytest.approx(3.182446 * np.std(means) * np.sqrt(4 / 3), rel=1e-5)


def test_what_does_not_vary_has_no_interval() -> None:
    for values in ([2.0], [2.0, 2.0], [[1.0, 1.0, 1.0]], [[3.0], [5.0]]):
        assert estimate(values).interval is None and not estimate(values).pair
    two = estimate([3.0, 6.0])
    assert (two.value, two.interval, two.pair) == (4.5, None, (3.0, 6.0)), "two say nothing of a spread"
    assert estimate([[1.0, np.nan, 5.0]]).count == 2


def test_weights_are_read_from_rows() -> None:
    rows = [weighted("a", 6.0, 2.0) | {"b": 1.0}, weighted("a", 10.0, 10.0), weighted("a", 1.0, 0.0)]
    found = row_estimates([rows])
    assert found["a"].value == pytest.approx(16 / 12) and found["b"].value == 1.0 and set(found) == {"a", "b"}


def test_a_file_comes_back(tmp_path: Path) -> None:
    facts = {"clips": 30, "sampling.top_p": None, "lengths": "free"}
    figures = (
        Figure("a.x", 0.1234567, 0.01, "mm", "lower", MODEL, facts, "A", "X", "clips"),
        Figure("a.x", 2.0, None, "mm", "lower", RECORDED, facts, "A", "X", note="few"),
        Figure("b.y", 0.5, protocol={"clips": 40}, group="B", title="Y", unit="share"),
        Figure("b.z", 0.5, protocol={"clips": 40}, group="B", title="Z", pair=(0.25, 0.75), count=12),
        Figure("b.w", 0.5, protocol={"clips": 40}, group="B", title="W", count=9),
    )
    FigureFile("evaluate", figures, {"stage": "e"}).write(tmp_path / "metrics.json")
    again = FigureFile.read(tmp_path / "metrics.json")
    assert again.figures == (replace(figures[0], value=0.12346), *figures[1:])
    assert (again.about, again.kind) == ({"stage": "e"}, "evaluate")
    first, second = figure_tables(again.figures)
    assert first[1:] == (["", "X, mm"], [["model", "0.1 ± 0.0"], [RECORDED, "2.0"]])
    assert all(words in first[0] for words in ("A", "30 clips", "over clips", "X: few"))
    assert second[2] == [["model", "50 %", "0.250 / 0.750", "–"]]
    assert second[0].count("–: of fewer than 10 clips") == 1 and "a / b" in second[0]


def test_below_ten_of_anything_there_is_a_dash() -> None:
    plain = Figure("b.y", 0.75, 0.1, "share", over="clips")
    eleven = replace(plain, protocol={"clips": 11, "candidates": 11})
    for one in (plain, eleven, replace(plain, protocol={"clips": 9}, count=10)):
        assert (one.text(), one.nothing) == ("75 % ± 10 %", "")
    for changed, why in (
        ({"interval": 0.8, "over": "repeats"}, "too few repeats"),
        ({"protocol": {"clips": 9}}, "of fewer than 10 clips"),
        ({"protocol": {"clips": 10, "candidates": 10}}, "among 10, which tells nothing"),
    ):
        one = replace(plain, **changed)  # type: ignore[arg-type]
        assert (one.text(), one.nothing) == ("–", why)


def test_the_terminal_gets_a_line_for_each_table() -> None:
    console = Console(width=100, record=True, file=io.StringIO())
    rows = [(MODEL, 1.0), (RECORDED, 2.0), (CHANCE, 3.0)]
    figures = [Figure(n, v, row=row, group=n[0], unit="mm") for n in ("a.x", "a.y", "b.z") for row, v in rows]
    print_summary([*figures, Figure("c.w", 1.0, group="c", count=3)], console)
    lines = [line.split() for line in console.export_text().splitlines()]
    assert [line[:3] for line in lines[1:3]] == [["a.x,", "mm", "1.0"], ["b.z,", "mm", "1.0"]]
    assert lines[1][3:] == ["2.0", *RECORDED.split()] and lines[3] == ["c.w", "–"] and len(lines) == 5


def test_a_statement_that_one_clip_makes_is_named() -> None:
    """FID_m is divided by the deviations of recorded motions; one in 300 that differs gives a small one."""
    rng = np.random.default_rng(0)
    data, made = ({"k": rng.random((n, 66)), "m": rng.random((n, 32))} for n in (300, 40))
    for plain in (True, False):
        found = movement_figures(data, made, {MODEL: [made, made]}, {})
        note = {one.name: one.note for one in found}["movement.fid_m"]
        assert plain != ("100 % of it is statement 5 of 32" in note and "1 of 300 recorded" in note)
        data["m"][:, 4] = 0.01 * (np.arange(300) == 7)


def reach(performance: Performance) -> Row:
    """How far the root gets, in metres: a new metric."""
    path = performance.joints[:, 0] - performance.joints[0, 0]
    return {"reach.root": float(np.linalg.norm(path, axis=-1).max())}


def test_a_new_metric_is_one_function(monkeypatch: pytest.MonkeyPatch) -> None:
    """It reaches the figures and the tables of terminal and report."""
    line = ClipMetric(
        "How far motions get", reach, (Metric("reach.root", "reach of the root", "higher", "m"),)
    )
    monkeypatch.setitem(clip_metrics.CLIP_METRICS._things, line.name, line)
    metrics, rng = clip_metrics.metrics_of("captions"), np.random.default_rng(0)
    real = [rng.normal(size=(20, 22, 3)) for _ in range(5)]
    rows = {
        row: [[measure_clip(metrics, Performance(size * one, one, 20.0)) for one in real]]
        for row, size in ((MODEL, 1.5), (RECORDED, 1.0))
    }
    title, columns, shown = figure_tables(clip_figures(metrics, rows, {"clips": 5}))[-1]
    assert title.startswith("How far motions get") and columns == ["", "reach of the root, m"]
    assert [row[0] for row in shown] == ["model", RECORDED]
