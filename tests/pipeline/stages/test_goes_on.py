"""Trainings that stop and go on: after a kill, for more steps, on two ranks; with all that has a state.

Two optimizers (one begins late and plays every second step), parts, averaged weights, dropout. The processes
of the two ranks run this file as a script.
"""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from same_stage import (
    assert_equal,
    assert_kills_change_nothing,
    assert_ranks_equal_one,
    assert_same_stage,
    newest,
)
from tiny_adversaries import Duel, train
from two_ranks import pair_of, work

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import Interrupted
from motionloom.pipeline.launch.team import lead_finds
from motionloom.pipeline.stages.networks.gpt import GptStageConfig
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training.checkpointing import readable
from motionloom.pipeline.training.config import TrainConfig

# A constant schedule for both: a cosine would depend on the number of steps.
CONSTANT: dict[str, Any] = {"critic": Duel(seed=0, max_steps=1).optim_config}
FULL: dict[str, Any] = {"ema": 0.9, "accumulate": 2}


@pytest.mark.parametrize("settings", [FULL, {**FULL, "precision": "bf16-mixed", "accumulate": 1}])
def test_killed_twice_equals_undisturbed(settings: dict[str, Any], tmp_path: Path) -> None:
    assert_kills_change_nothing(train, tmp_path, (9, 20), 18, **settings)


def test_killed_behind_the_last_step_hands_over_the_average(tmp_path: Path) -> None:
    first = train(tmp_path, ema=0.9)
    again = train(tmp_path, ema=0.9)
    assert_equal(first.net.state_dict(), again.net.state_dict())


def test_the_average_is_that_of_the_weights(tmp_path: Path) -> None:
    """Of every step, from the first; validation sees it, training does not."""
    plain = train(tmp_path / "plain")
    weights = []
    for steps in range(1, 9):  # the weights after each step: without schedule they begin every training
        weights.append(train(tmp_path / str(steps), steps=steps, module=CONSTANT).net[0].weight.detach())
    expected = weights[0].double()
    for count, weight in enumerate(weights[1:], start=1):
        decay = min(0.4, (1 + count) / (10 + count))
        expected = decay * expected + (1 - decay) * weight.double()
    averaged = train(tmp_path / "averaged", steps=8, ema=0.4, checkpoint_every=8, module=CONSTANT)
    torch.testing.assert_close(averaged.net[0].weight.double(), expected, rtol=0, atol=1e-6)
    trained = newest(tmp_path / "averaged")["state_dict"]["net.0.weight"]
    assert torch.equal(trained, weights[-1])
    train(tmp_path / "watched", ema=0.9)
    assert_equal(newest(tmp_path / "watched")["state_dict"], plain.state_dict())
    rows = [read_training_log(tmp_path / name) for name in ("plain", "watched")]
    for one, two in zip(*rows, strict=True):
        assert (one == two) == ("train/loss" in one)


def test_an_average_of_cut_weights_is_refused() -> None:
    config = GptStageConfig(train=TrainConfig(strategy="fsdp", ema=0.99))
    with pytest.raises(UserError, match=r"train\.ema averages whole weights"):
        config.require_fit(Hardware(accelerator="cpu", devices=2))


@pytest.mark.parametrize(
    ("short", "every", "first"),
    [(12, 6, 12), (16, 6, 16), (8, 6, 8)],  # whole chunks, and a last one that was cut short
)
def test_longer_equals_long(short: int, every: int, first: int, tmp_path: Path) -> None:
    settings = {**FULL, "checkpoint_every": every, "validate_every": 6, "module": CONSTANT}
    long = train(tmp_path / "long", **settings)
    train(tmp_path / "longer", steps=short, **settings)
    path, content = next(readable(tmp_path / "longer/checkpoints"))
    assert path.stem == f"step={first:08d}" and content["steps"] == short
    with pytest.raises(ConnectionResetError):
        train(tmp_path / "longer", dies_at=20, **settings)
    longer = train(tmp_path / "longer", **settings)
    assert_same_stage(tmp_path / "long", tmp_path / "longer", long, longer)


def test_a_damaged_newest_checkpoint_changes_no_weight(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The one before it is used, and what a killed writer left is gone."""
    settings = {"steps": 8, "checkpoint_every": 2, "validate_every": 0}
    whole = train(tmp_path / "whole", **settings)
    with pytest.raises(ConnectionResetError):
        train(tmp_path / "hit", dies_at=7, **settings)
    folder = tmp_path / "hit/checkpoints"
    names = ["step=00000004.ckpt", "step=00000006.ckpt"]
    assert sorted(path.name for path in folder.iterdir()) == names
    damaged = bytearray((folder / names[1]).read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (folder / names[1]).write_bytes(damaged)
    (folder / f".{names[1]}.{'0' * 16}.tmp").write_bytes(damaged[:100])
    again = train(tmp_path / "hit", console=Console(width=999), **settings)
    assert_same_stage(tmp_path / "whole", tmp_path / "hit", whole, again)
    said = capsys.readouterr().out
    assert f"{folder / names[1]}: the bytes" in said
    assert sorted(path.name for path in folder.iterdir()) == ["step=00000006.ckpt", "step=00000008.ckpt"]


def test_workers_change_nothing(tmp_path: Path) -> None:
    """They live from chunk to chunk, each chunk begins at its own batch, and no signal ends them."""
    settings = {"steps": 8, "checkpoint_every": 2, "validate_every": 0}
    alone = train(tmp_path / "alone", **settings)
    # It reaches the reader: a worker, as one to the whole group of processes does.
    reached = {3: signal.SIGTERM}
    other = train(tmp_path / "other", hardware={"workers": 1}, signalled=reached, **settings)
    assert_same_stage(tmp_path / "alone", tmp_path / "other", alone, other)
    assert alone.readers == {os.getpid()} and len(other.readers - alone.readers) == 1


def interrupt(out: Path, rank: int, hardware: dict[str, Any]) -> None:
    """One rank gets the signal, or the other, or both; all stop at the same step and go on from there."""
    settings = {**FULL, "checkpoint_every": 7, "validate_every": 7, "hardware": hardware}
    whole = train(out / "whole", **settings)
    stops = []
    for step, ranks in ((1, (1,)), (9, (0,)), (17, (0, 1))):
        signalled = {step: signal.SIGTERM} if rank in ranks else None
        with pytest.raises(Interrupted) as stopped:
            train(out / "interrupted", signalled=signalled, **settings)
        stops.append(stopped.value.step)
        if step == 1:  # in the first validation, of one rank
            signalled = {0: signal.SIGTERM} if rank == 1 else None
            with pytest.raises(Interrupted, match="step 7 of 24"):
                train(out / "interrupted", validation_signalled=signalled, **settings)
    again = train(out / "interrupted", **settings)
    assert_equal(whole.state_dict(), again.state_dict())
    (out / f"stops-{rank}.json").write_text(json.dumps(stops))


def worker(out: Path) -> None:
    pair = {"hardware": {"devices": 2}, "module": {"dropout": 0.0}}
    for name, settings in PAIRS.items():
        duel = train(out / name, **pair, **settings)
        torch.save(duel.state_dict(), out / f"{name}-{os.environ['RANK']}.pt")
    interrupt(out, int(os.environ["RANK"]), pair["hardware"])
    # Which checkpoint a training goes on from is found once, also where the ranks see different files.
    assert lead_finds(lambda: out / os.environ["RANK"]) == out / "0"


PAIRS: dict[str, dict[str, Any]] = {
    "float32": {"ema": 0.9},
    "float64": {"dtype": torch.float64, "ema": 0.9, "accumulate": 2},
}
BOUNDS = {"float32": 1e-5, "float64": 1e-12}


pair = pair_of(__file__)


@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", list(PAIRS))
def test_two_ranks_equal_one_with_two_optimizers(name: str, pair: Path, tmp_path: Path) -> None:
    one = train(tmp_path, module={"dropout": 0.0}, **PAIRS[name])
    assert_ranks_equal_one(one, tmp_path, pair, name, BOUNDS[name])


@pytest.mark.timeout(240)
def test_two_ranks_agree_on_the_step_of_a_signal(pair: Path) -> None:
    first, second = (json.loads((pair / f"stops-{rank}.json").read_text()) for rank in range(2))
    assert first == second
    for step, signalled in zip(first, (2, 10, 18), strict=True):
        assert signalled <= step <= -(-signalled // 7) * 7  # at the latest where the chunk ends
    assert_equal(newest(pair / "whole"), newest(pair / "interrupted"))
    assert read_training_log(pair / "whole") == read_training_log(pair / "interrupted")


if __name__ == "__main__":
    work(worker)
