"""What the flight recorder notes agrees with what is known otherwise, and changes nothing of a training."""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from tiny_players import train
from torch import Tensor

from motionloom.pipeline.flight.ranks import waited_in_steps
from motionloom.pipeline.flight.waits import Waited
from motionloom.pipeline.stages.training import read_metrics
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.checkpoints import read_checkpoint
from motionloom.pipeline.store.flight_log import read_flight

STEPS: dict[str, Any] = {"steps": 24, "checkpoint_every": 12, "validate_every": 12}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A training of two players whose steps 11 to 13 are profiled, and what it said."""
    folder, console = tmp_path_factory.mktemp("flight") / "duel", Console(record=True, width=200)
    train(folder, console=console, hardware={"loggers": ("csv",), "profile": 3}, **STEPS)
    return folder, console.export_text()


def test_rows_agree_with_the_log(trained: tuple[Path, str]) -> None:
    folder, _ = trained
    rows = read_flight(folder)[0]
    assert [row["step"] for row in rows] == [10, 20] and [r["batches"] for r in rows] == [[0, 9], [10, 19]]
    gauges = json.loads(
        read_checkpoint(folder / "checkpoints/step=00000024.ckpt")["callbacks"]["MetricLog"]["gauges"]
    )
    logged = {row["step"]: more for row, more in zip(read_metrics(folder), gauges, strict=True) if more}
    for row in rows:
        # The generator's parts together are its gradient, whose norm is logged before it is clipped.
        own = [norm for name, norm in row["grad_norm"].items() if name not in ("critic", "unused")]
        assert math.hypot(*own) == pytest.approx(logged[row["step"]]["grad_norm/generator"], rel=1e-5)
        assert row["samples_per_second"] > 0 and row["frames_per_second"] == pytest.approx(
            row["samples_per_second"]  # of length 1 each
        )
        assert 0 < row["step_seconds"] <= row["step_seconds_p95"] and row["rss_mib"] > 50
        assert set(row["waited"]) == {"data", "checkpoints", "ranks"}
        assert all(0 <= share <= 1 for share in row["waited"].values())
        assert logged[row["step"]]["flight/grad_norm/0"] == row["grad_norm"]["0"]


def test_a_player_that_has_no_turn_at_a_rows_end_is_measured(trained: tuple[Path, str]) -> None:
    """The critic begins at step 4 and plays every second one; rows end with odd ones."""
    rows = read_flight(trained[0])[0]
    assert all(row["grad_norm"]["critic"] > 0 for row in rows)


def test_weight_norms_are_those_of_the_weights(tmp_path: Path) -> None:
    train(tmp_path, **{**STEPS, "steps": 20, "checkpoint_every": 10})
    row = read_flight(tmp_path)[0][1]
    state = read_checkpoint(tmp_path / "checkpoints/step=00000020.ckpt")["state_dict"]
    for group in ("0", "3"):
        own = [value.double() for name, value in state.items() if name.startswith(f"net.{group}.")]
        expected = torch.cat([value.reshape(-1) for value in own]).norm().item()
        assert row["weight_norm"][group] == pytest.approx(expected, rel=1e-6)


def test_one_line_says_how_fast_it_was_and_what_it_waited_for(trained: tuple[Path, str]) -> None:
    (line,) = [line for line in trained[1].splitlines() if "samples/s" in line]
    assert line.startswith("    duel: ") and " frames/s; waited " in line
    assert line.rstrip().endswith("% for checkpoints")  # and for no other ranks: there are none


def test_it_changes_no_weight_and_is_no_output(trained: tuple[Path, str], tmp_path: Path) -> None:
    train(tmp_path, hardware={"flight_rows": 0}, **STEPS)
    assert not (tmp_path / "flight").exists()
    one, two = (
        read_checkpoint(folder / "checkpoints/step=00000024.ckpt")["state_dict"]
        for folder in (trained[0], tmp_path)
    )
    assert all(torch.equal(value, two[name]) for name, value in one.items())
    blank = Artifact(stage="duel", kind="duel", version=1, fingerprint="", seed=0, config={}, inputs={})
    assert set(blank.finish(trained[0]).outputs) == {"metrics.jsonl"}


def test_the_profile_opens_and_names_the_operations(trained: tuple[Path, str]) -> None:
    folder, said = trained
    trace = json.loads(gzip.decompress((folder / "flight/profile_rank_0.json.gz").read_bytes()))
    names = {event.get("name") for event in trace["traceEvents"]}
    assert {"aten::addmm", "Optimizer.step#Adam.step"} <= names
    steps = [event for event in trace["traceEvents"] if event.get("name") == "Optimizer.step#Adam.step"]
    assert len([event for event in steps if event.get("cat") == "user_annotation"]) == 3
    assert "aten::addmm" in (folder / "flight/profile_rank_0.txt").read_text()
    assert "duel: profile of steps 11 to 13 in" in said
    assert {path.name for path in (folder / "flight").iterdir()} == {
        *("rank_0.jsonl", "profile_rank_0.json.gz", "profile_rank_0.txt")
    }


def test_who_comes_late_to_a_step_keeps_the_others_waiting() -> None:
    """Steps end together; the second rank's last two began 0.3 s and 0.1 s later than the first's."""
    seconds: Tensor = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.7, 0.9]], dtype=torch.float64)
    assert waited_in_steps(seconds, 0) == pytest.approx(0.4)
    assert waited_in_steps(seconds, 1) == 0


def test_shares_are_of_the_time_that_has_gone_by() -> None:
    whole = Waited()
    for _ in range(2):
        whole.add(Waited(wall=10.0, data=0.04, checkpoints=0.01, ranks=0.02))
    assert whole.shares() == pytest.approx({"data": 0.004, "checkpoints": 0.001, "ranks": 0.002})
    assert whole.say(team=True) == "waited 0.4 % for data, 0.1 % for checkpoints, 0.2 % for other ranks"
    assert whole.say(team=False) == "waited 0.4 % for data, 0.1 % for checkpoints"
