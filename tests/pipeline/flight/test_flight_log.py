"""Flight logs stay bounded, show each step once after a kill, and survive a line that was cut short."""

from __future__ import annotations

import json
from pathlib import Path

from motionloom.pipeline.store.flight_log import FlightLog, read_flight, read_rows


def steps(path: Path) -> list[int]:
    return [row["step"] for row in read_rows(path)]


def test_it_never_has_more_rows_than_it_may_and_keeps_the_latest(tmp_path: Path) -> None:
    path = tmp_path / "flight/rank_0.jsonl"
    log = FlightLog(path, 20)
    log.begin(0)
    longest = 0
    for step in range(10, 5001, 10):
        log.take({"step": step})
        longest = max(longest, len(path.read_text().splitlines()))
    kept = steps(path)
    assert longest == 20 and kept == sorted(set(kept))
    assert kept[0] == 10 and kept[-5:] == [4960, 4970, 4980, 4990, 5000]


def test_steps_that_come_again_are_there_once(tmp_path: Path) -> None:
    path = tmp_path / "flight/rank_0.jsonl"
    log = FlightLog(path, 100)
    log.begin(0)
    for step in (10, 20, 30):
        log.take({"step": step, "try": 1})
    with path.open("a") as file:
        file.write('{"step": 40, "t')  # killed here
    again = FlightLog(path, 100)
    again.begin(20)
    for step in (30, 40):
        again.take({"step": step, "try": 2})
    assert [(row["step"], row["try"]) for row in read_rows(path)] == [(10, 1), (20, 1), (30, 2), (40, 2)]


def test_all_ranks_are_read(tmp_path: Path) -> None:
    for rank in (0, 1, 10):
        log = FlightLog(tmp_path / f"flight/rank_{rank}.jsonl", 9)
        log.begin(0)
        log.take({"step": 10, "rank": rank})
    (tmp_path / "flight/rank_x.jsonl").write_text(json.dumps({"step": 1}))
    assert {rank: rows[0]["rank"] for rank, rows in read_flight(tmp_path).items()} == {0: 0, 1: 1, 10: 10}
    assert read_flight(tmp_path / "nowhere") == {}
