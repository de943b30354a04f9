"""Lines of a log without a terminal: when they come, and the time that is left."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from motionloom.datasets.base.progress import Meter, Pace, duration


class Clock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_time_left_goes_by_what_was_done_here() -> None:
    """A resumed training had its first 400 steps from before: 100 steps in 50 s leave 1,000 s for 2,000."""
    clock = Clock()
    pace = Pace(2500, 400, clock)
    assert pace.left(400) == "", "nothing is known yet"
    clock.now += 50
    assert pace.speed(500) == 2.0
    assert pace.left(500) == "16 min 40 s left"
    assert pace.left(2500) == ""


def test_lines_come_every_15_seconds_and_at_the_end_of_what_took_as_long() -> None:
    clock = Clock()
    pace = Pace(10, clock=clock)
    due = []
    for done in range(1, 11):
        clock.now += 5
        due.append(pace.due(done))
    assert [number for number, said in enumerate(due, start=1) if said] == [3, 6, 9, 10]
    assert not Pace(10, clock=clock).due(10), "what is quick says nothing"


def test_a_meter_prints_lines_where_there_is_no_terminal() -> None:
    clock, log = Clock(), io.StringIO()
    with Meter("generating", 40, done=8, console=Console(file=log, width=100), clock=clock) as meter:
        for _ in range(4):
            clock.now += 10
            meter.advance(8)
    assert log.getvalue().splitlines() == ["    generating: 24/40  20 s left", "    generating: 40/40"]


@pytest.mark.parametrize("hidden", [{"shown": False}, {"console": Console(quiet=True)}])
def test_a_meter_that_is_not_shown(hidden: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with Meter("generating", 2, clock=clock, **hidden) as meter:  # type: ignore[arg-type]
        clock.now += 100
        meter.advance()
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.04, "0.0 s"),
        (9.96, "10 s"),
        (59.4, "59 s"),
        (200, "3 min 20 s"),
        (7500, "2 h 05 min"),
        (9e5, "10 d 10 h"),
    ],
)
def test_durations(seconds: float, said: str) -> None:
    assert duration(seconds) == said
