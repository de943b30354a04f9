"""Flight logs: what they hold, what is left after a kill, and the report's section."""

from __future__ import annotations

import json
import re
from io import StringIO
from pathlib import Path

import pytest
import torch
from rich.console import Console
from tiny_adversaries import DIM, Duel, Vectors, train

from motionloom.datasets.base.files import write_text
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.stages.results.report_parts import draw_flights
from motionloom.pipeline.store.run_state import RunState, StageState
from motionloom.pipeline.store.training_log import read_flight, read_rows, read_starts, read_training_log
from motionloom.pipeline.training.telemetry import WaitTimes, waited_in_steps
from motionloom.pipeline.training.utilization import Utilization, pass_flops


def test_a_training_notes_speed_and_waits(tmp_path: Path) -> None:
    train(tmp_path)
    rows = read_flight(tmp_path)[0]
    assert [row["step"] for row in rows] == [10, 20]
    for row in rows:
        assert row["samples_per_second"] > 0 and row["frames_per_second"] == row["samples_per_second"]
        assert 0 < row["step_seconds"] <= row["step_seconds_p95"]
        assert all(0 <= row[f"waited/{cause}"] <= 1 for cause in WaitTimes(torch.device("cpu")))
        assert 0 < row["goodput"] < 1 and "mfu" not in row  # a CPU has no peak


def test_a_rank_waits_for_the_one_that_comes_last() -> None:
    seconds = torch.tensor([[3.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    assert [waited_in_steps(seconds, rank) for rank in (0, 1)] == [2.0, 0.0]
    waits = WaitTimes(torch.device("cpu"))
    waits["data"] = 3.0
    nothing = dict.fromkeys(waits, 0.0)
    assert waits.shares(nothing | {"data": 1.0}, 4.0) == nothing | {"data": 0.5}


def test_a_gpu_waits_only_when_it_has_nothing_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process waits a moment twice; the GPU has work left the first time, none the second."""
    free_at = iter([5.0, 5.0, 7.0, 9.0])

    class Event:
        def __init__(self, *, enable_timing: bool) -> None:
            assert enable_timing
            self.done = False

        def record(self) -> None:
            self.at = next(free_at)

        def synchronize(self) -> None:
            self.done = True

        def elapsed_time(self, end: Event) -> float:
            assert end.done
            return 1000 * (end.at - self.at)

    monkeypatch.setattr(torch.cuda, "Event", Event)
    waits = WaitTimes(torch.device("cuda"))
    for wanted in (0.0, 2.0):
        before = waits.process
        with waits.waiting_for("data"):
            pass
        waits.read()
        assert waits["data"] == wanted and waits.process > before


def test_steps_that_come_again_are_there_once(tmp_path: Path) -> None:
    path = tmp_path / "flight/rank_0.jsonl"
    with pytest.raises(ConnectionResetError):
        train(tmp_path, steps=40, dies_at=33)
    with path.open("a") as file:
        file.write('{"step": 40, "t')  # killed here
    train(tmp_path, steps=40)
    assert [row["step"] for row in read_rows(path)] == [10, 20, 30, 40]
    ((step, reached),) = read_starts(tmp_path)
    assert step <= reached == 30
    (tmp_path / "flight/rank_x.jsonl").write_text(json.dumps({"step": 1}))
    assert list(read_flight(tmp_path)) == [0]


def test_goodput_counts_the_steps_that_stay() -> None:
    """Two processes: the second takes steps 13 to 20 again, which a kill has undone."""
    now = 0.0
    first = Utilization([], 0, at_peak=0.25, clock=lambda: now)
    now = 13.0  # 4 seconds until the first step is over
    seconds, figures = first.row(9, 4.0)
    assert seconds == 1 and figures == {"elapsed_seconds": 13, "goodput": 9 / 13, "mfu": 0.25}
    now = 25.0  # 2 seconds of a validation
    rows = [{"step": 10.0, **figures}, {"step": 20.0, **first.row(10, 6.0)[1]}]
    assert rows[1]["goodput"] == 19 / 25 and rows[1]["mfu"] == 0.25
    now = 100.0
    second = Utilization(rows, 12, 0.0, clock=lambda: now)
    now = 108.0
    assert second.row(7, 1.0) == (1, {"elapsed_seconds": 33, "goodput": 16 / 33})


def test_a_known_peak_gives_the_share_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU. Nothing of the training changes, and the line shows it."""
    plain = train(tmp_path / "plain")
    monkeypatch.setattr("motionloom.pipeline.training.trainer.peak_flops", lambda *_: 1e9)
    said = StringIO()
    counted = train(tmp_path / "counted", console=Console(file=said, width=500))
    assert all(map(torch.equal, counted.state_dict().values(), plain.state_dict().values()))
    assert re.search(r"duel: .*frames/s, MFU \d+\.\d %, goodput \d+\.\d %; waited", said.getvalue())
    assert all(row["mfu"] > 0 for row in read_flight(tmp_path / "counted")[0])


def test_flops_are_those_of_the_matrix_products() -> None:
    """Forward, gradients of weights, and of inputs but the first's: 2 M N K each."""
    duel, batch = Duel(seed=3, max_steps=4), Vectors(8)[0]
    first, second = 2 * 8 * DIM * 16, 2 * 8 * 16 * DIM
    critic = 2 * 8 * (DIM * 8 + 8)
    # The generator is judged by the critic once; the critic judges the batch and what was made, twice.
    own = 2 * first + 3 * second + 3 * critic + 2 * 3 * critic - 2 * 2 * 8 * DIM * 8
    before = torch.get_rng_state()
    assert pass_flops(duel, batch) == own
    assert torch.equal(torch.get_rng_state(), before) and not duel.figures
    assert all(param.grad is None for param in duel.parameters())


def test_telemetry_ends_no_training(tmp_path: Path) -> None:
    """Its folder is a file: it is left out with a warning."""
    tmp_path.joinpath("flight").write_text("")
    said = StringIO()
    train(tmp_path, console=Console(file=said, width=500))
    warnings = [line.split(":")[0].strip() for line in said.getvalue().splitlines() if "left out" in line]
    assert warnings == ["telemetry of rank 0 is left out"]
    assert read_training_log(tmp_path)[-1]["step"] == 24


def test_the_report_shows_speed_and_waits(tmp_path: Path) -> None:
    stages = tuple(StageState(name, "toy", tmp_path / name, {}, "finished") for name in ("data", "gpt"))
    state, empty = RunState(tmp_path, "toys", 1, stages), Page("title")
    draw_flights(empty, state)
    assert "How the trainings ran" not in empty.html()
    for rank, waited in enumerate((0.1, 0.3)):
        times = {"samples_per_second": 200.0, "step_seconds": 0.1, "step_seconds_p95": 0.4}
        row = {"step": 10, **times, "waited/data": waited, "waited/checkpoints": 0.02}
        write_text(tmp_path / f"gpt/flight/rank_{rank}.jsonl", json.dumps(row) + "\n")
    page = Page("title")
    draw_flights(page, state)
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", page.html())
    assert cells[:6] == ["gpt", "200.00", "0.10", "20.00", "2.00", "0.00"]
