"""The report's section on how trainings ran."""

from __future__ import annotations

import re
from pathlib import Path

from motionloom.pipeline.render.page import Page
from motionloom.pipeline.stages.report_flight import draw_flights, norm_lines
from motionloom.pipeline.store.flight_log import FlightLog
from motionloom.pipeline.store.run_state import RunState, StageState


def state(folder: Path, *names: str) -> RunState:
    stages = tuple(StageState(name, "toy", folder / name, {}, "finished") for name in names)
    return RunState(folder, "toys", 1, None, {}, stages)


def write(folder: Path, rank: int, waited: float) -> None:
    log = FlightLog(folder / f"flight/rank_{rank}.jsonl", 100)
    log.begin(0)
    for step in (10, 20, 30):
        log.take(
            {
                "step": step,
                "samples_per_second": 100.0 * step,
                "step_seconds": 0.1,
                "step_seconds_p95": 0.4,
                "waited": {"data": waited, "checkpoints": 0.02, "ranks": 0.0},
                "grad_norm": {f"layer{n}": 1.0 + n for n in range(12)},
            }
        )


def test_speed_waits_and_charts_are_there(tmp_path: Path) -> None:
    write(tmp_path / "gpt", 0, 0.1)
    write(tmp_path / "gpt", 1, 0.3)
    (tmp_path / "gpt/crash/step_00000007").mkdir(parents=True)
    page = Page("title")
    draw_flights(page, state(tmp_path, "data", "gpt"))
    html = page.html()
    assert "How the trainings ran" in html and "gpt/crash/step_00000007" in html
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", html)
    assert cells[:5] == ["gpt", "2000.0", "20.0", "2.0", "0.0"]
    assert "gpt: seconds a step" in html and "95 %, rank 1" in html


def test_without_flight_logs_there_is_no_section(tmp_path: Path) -> None:
    page = Page("title")
    draw_flights(page, state(tmp_path, "data"))
    assert "How the trainings ran" not in page.html()


def test_as_many_layer_groups_are_drawn_as_there_are_colours(tmp_path: Path) -> None:
    rows = [{"step": 10, "grad_norm": {f"layer{n}": float(n) for n in range(12)}}]
    assert [line.name for line in norm_lines(rows)] == [f"layer{n}" for n in range(4, 12)]
