"""Flight logs: what they hold, how long they may get, what is left after a kill, and the report's section."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from tiny_players import train

from motionloom.pipeline.render.page import Page
from motionloom.pipeline.stages.results.report_drawings import draw_flights
from motionloom.pipeline.store.run_state import RunState, StageState
from motionloom.pipeline.store.training_log import FlightLog, read_flight, read_rows
from motionloom.pipeline.training.telemetry import WaitTimes, waited_in_steps


def test_a_training_notes_speed_and_waits(tmp_path: Path) -> None:
    train(tmp_path)
    rows = read_flight(tmp_path)[0]
    assert [row["step"] for row in rows] == [10, 20]
    for row in rows:
        assert row["samples_per_second"] > 0 and row["frames_per_second"] == row["samples_per_second"]
        assert 0 < row["step_seconds"] <= row["step_seconds_p95"]
        assert all(0 <= row[f"waited/{cause}"] <= 1 for cause in ("data", "checkpoints", "ranks"))
    train(tmp_path / "none", hardware={"flight_rows": 0})
    assert read_flight(tmp_path / "none") == {}


def test_a_rank_waits_for_the_one_that_comes_last() -> None:
    seconds = torch.tensor([[3.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    assert [waited_in_steps(seconds, rank) for rank in (0, 1)] == [2.0, 0.0]
    waits = WaitTimes(data=3.0, wall=10.0).since(WaitTimes(data=1.0, wall=6.0))
    assert waits.shares() == pytest.approx({"data": 0.5, "checkpoints": 0.0, "ranks": 0.0})


def test_a_log_never_has_more_rows_than_it_may_and_keeps_the_latest(tmp_path: Path) -> None:
    path = tmp_path / "flight/rank_0.jsonl"
    log = FlightLog(path, 20)
    log.begin(0)
    longest = 0
    for step in range(10, 2001, 10):
        log.append({"step": step})
        longest = max(longest, len(path.read_text().splitlines()))
    kept = [row["step"] for row in read_rows(path)]
    assert longest == 20 and kept == sorted(set(kept))
    assert kept[0] == 10 and kept[-5:] == [1960, 1970, 1980, 1990, 2000]


def test_steps_that_come_again_are_there_once(tmp_path: Path) -> None:
    path = tmp_path / "flight/rank_0.jsonl"
    log = FlightLog(path, 100)
    log.begin(0)
    for step in (10, 20, 30):
        log.append({"step": step, "try": 1})
    with path.open("a") as file:
        file.write('{"step": 40, "t')  # killed here
    again = FlightLog(path, 100)
    again.begin(20)
    again.append({"step": 30, "try": 2})
    assert [(row["step"], row["try"]) for row in read_rows(path)] == [(10, 1), (20, 1), (30, 2)]
    (tmp_path / "flight/rank_x.jsonl").write_text(json.dumps({"step": 1}))
    assert list(read_flight(tmp_path)) == [0]


def test_the_report_shows_speed_and_waits(tmp_path: Path) -> None:
    stages = tuple(StageState(name, "toy", tmp_path / name, {}, "finished") for name in ("data", "gpt"))
    state, empty = RunState(tmp_path, "toys", 1, None, {}, stages), Page("title")
    draw_flights(empty, state)
    assert "How the trainings ran" not in empty.html()
    for rank, waited in enumerate((0.1, 0.3)):
        log = FlightLog(tmp_path / f"gpt/flight/rank_{rank}.jsonl", 100)
        log.begin(0)
        times = {"samples_per_second": 200.0, "step_seconds": 0.1, "step_seconds_p95": 0.4}
        log.append({"step": 10, **times, "waited/data": waited, "waited/checkpoints": 0.02})
    (tmp_path / "gpt/crash/step_00000007").mkdir(parents=True)
    page = Page("title")
    draw_flights(page, state)
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", page.html())
    assert cells[:5] == ["gpt", "200.0", "20.0", "2.0", "0.0"] and "gpt/crash/step_00000007" in page.html()
