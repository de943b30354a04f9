"""Flight logs: what they hold, what is left after a kill, and the report's section."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from tiny_adversaries import train

from motionloom.datasets.base.files import write_text
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.stages.results.report_parts import draw_flights
from motionloom.pipeline.store.run_state import RunState, StageState
from motionloom.pipeline.store.training_log import read_flight, read_rows
from motionloom.pipeline.training.telemetry import WaitTimes, waited_in_steps


def test_a_training_notes_speed_and_waits(tmp_path: Path) -> None:
    train(tmp_path)
    rows = read_flight(tmp_path)[0]
    assert [row["step"] for row in rows] == [10, 20]
    for row in rows:
        assert row["samples_per_second"] > 0 and row["frames_per_second"] == row["samples_per_second"]
        assert 0 < row["step_seconds"] <= row["step_seconds_p95"]
        assert all(0 <= row[f"waited/{cause}"] <= 1 for cause in ("data", "checkpoints", "ranks"))


def test_a_rank_waits_for_the_one_that_comes_last() -> None:
    seconds = torch.tensor([[3.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    assert [waited_in_steps(seconds, rank) for rank in (0, 1)] == [2.0, 0.0]
    waits = WaitTimes()
    waits["data"] = 3.0
    before = {"data": 1.0, "checkpoints": 0.0, "ranks": 0.0}
    assert waits.shares(before, 4.0) == {"data": 0.5, "checkpoints": 0.0, "ranks": 0.0}


def test_steps_that_come_again_are_there_once(tmp_path: Path) -> None:
    path = tmp_path / "flight/rank_0.jsonl"
    with pytest.raises(ConnectionResetError):
        train(tmp_path, steps=40, dies_at=33)
    with path.open("a") as file:
        file.write('{"step": 40, "t')  # killed here
    train(tmp_path, steps=40)
    assert [row["step"] for row in read_rows(path)] == [10, 20, 30, 40]
    (tmp_path / "flight/rank_x.jsonl").write_text(json.dumps({"step": 1}))
    assert list(read_flight(tmp_path)) == [0]


def test_the_report_shows_speed_and_waits(tmp_path: Path) -> None:
    stages = tuple(StageState(name, "toy", tmp_path / name, {}, "finished") for name in ("data", "gpt"))
    state, empty = RunState(tmp_path, "toys", 1, None, {}, stages), Page("title")
    draw_flights(empty, state)
    assert "How the trainings ran" not in empty.html()
    for rank, waited in enumerate((0.1, 0.3)):
        times = {"samples_per_second": 200.0, "step_seconds": 0.1, "step_seconds_p95": 0.4}
        row = {"step": 10, **times, "waited/data": waited, "waited/checkpoints": 0.02}
        write_text(tmp_path / f"gpt/flight/rank_{rank}.jsonl", json.dumps(row) + "\n")
    (tmp_path / "gpt/crash/step_00000007").mkdir(parents=True)
    page = Page("title")
    draw_flights(page, state)
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", page.html())
    assert cells[:6] == ["gpt", "200.00", "0.10", "20.00", "2.00", "0.00"]
    assert "gpt/crash/step_00000007" in page.html()
