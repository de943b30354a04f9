"""Checkpoints written beside a training: the same bytes, of the moment they were asked for, or a sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from same_stage import assert_equal
from tiny_players import train
from torch import Tensor, nn

from motionloom.datasets.base.files import remove_temporaries
from motionloom.datasets.schema import UserError
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training.checkpointing import (
    BackgroundWriter,
    name_of,
    read_checkpoint,
    readable,
    step_of,
)


def newest(folder: Path) -> Path:
    return next(readable(folder))[0]


def state() -> dict[str, Any]:
    """What trainings have: views, empty tensors, state of optimizers by number."""
    torch.manual_seed(0)
    table = torch.arange(20.0).reshape(4, 5)
    return {
        "state_dict": nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4)).state_dict(),
        "optimizer_states": [{"state": {0: {"step": torch.tensor(3.0), "exp_avg": table[1]}}, "b": (0, 1)}],
        "average": {"table": table, "none": torch.empty(0), "kinds": torch.tensor([1], dtype=torch.int8)},
        "rows": '[{"step": 10}]',
        "global_step": 7,
    }


def change(value: Any) -> None:
    """Every tensor and every list of it, in place."""
    if isinstance(value, Tensor):
        value.data.zero_()
    elif isinstance(value, dict):
        for inner in value.values():
            change(inner)
        value["new"] = 1
    elif isinstance(value, list):
        for inner in value:
            change(inner)
        value.clear()


def test_what_is_trained_meanwhile_is_not_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state of the moment, however late the thread gets to it; and one file at a time."""
    go = threading.Event()
    synced = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: (go.wait(30), synced(handle)))
    writer = BackgroundWriter(keep=2)
    trained = state()
    writer.write(trained, tmp_path / name_of(7))
    change(trained)
    assert writer.busy and not (tmp_path / name_of(7)).exists()
    threading.Timer(0.2, go.set).start()
    writer.write({"global_step": 14}, tmp_path / name_of(14))
    assert (tmp_path / name_of(7)).exists()
    writer.finish()
    assert not writer.busy and newest(tmp_path) == tmp_path / name_of(14)
    assert_equal(dict(read_checkpoint(tmp_path / name_of(7))), state())


@pytest.mark.parametrize("ask", ["write", "finish"])
def test_an_error_comes_out_where_the_training_asks_next(
    ask: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = BackgroundWriter(keep=2)
    for step in (1, 2):
        writer.write({"global_step": step}, tmp_path / name_of(step))
    writer.finish()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    writer.write({"global_step": 3}, tmp_path / name_of(3))
    while writer.busy:
        time.sleep(0.001)
    with pytest.raises(UserError, match=r"3\.ckpt: the checkpoint cannot be written \(No space left"):
        writer.write({}, tmp_path / name_of(4)) if ask == "write" else getattr(writer, ask)()
    assert sorted(path.name for path in tmp_path.iterdir()) == [name_of(1), name_of(2)]
    writer.finish()  # once


@pytest.mark.parametrize(
    ("keep", "every", "found", "steps", "expected"),
    [
        (2, 0, (), (5, 10, 15, 20), {15, 20}),
        (3, 0, (), (5, 10, 15, 20), {10, 15, 20}),
        (2, 10, (), (5, 10, 15, 20, 25, 30, 35), {10, 20, 30, 35}),
        (2, 0, (5, 10), (15,), {10, 15}),
        (2, 4, (4, 8), (14,), {4, 8, 14}),
    ],
)
def test_what_is_kept(
    keep: int, every: int, found: tuple[int, ...], steps: tuple[int, ...], expected: set[int], tmp_path: Path
) -> None:
    for step in found:
        (tmp_path / name_of(step)).write_bytes(b"")
    (tmp_path / "notes.ckpt").write_bytes(b"")
    writer = BackgroundWriter(keep=keep, keep_every=every)
    for step in steps:
        writer.write({"global_step": step}, tmp_path / name_of(step))
    writer.finish()
    assert {step_of(path) for path in tmp_path.iterdir()} == {*expected, None}


def test_a_training_keeps_what_it_is_told_to(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"checkpoint_every": 2, "validate_every": 0, "keep_checkpoints": 3}
    train(tmp_path, steps=24, keep_every=8, **settings)
    kept = sorted(step_of(path) or 0 for path in (tmp_path / "checkpoints").iterdir())
    assert kept == [8, 16, 20, 22, 24]


def test_a_full_disk_ends_a_training_with_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The log on disk is that of the checkpoint before, and the same command goes on from it."""
    settings: dict[str, Any] = {"checkpoint_every": 5, "validate_every": 0}
    whole = train(tmp_path / "whole", **settings)
    with monkeypatch.context() as patch:
        synced = os.fsync

        def full(handle: int) -> None:
            if name_of(15) in str(Path(f"/proc/self/fd/{handle}").readlink()):
                raise OSError(28, "No space left on device")
            synced(handle)

        patch.setattr(os, "fsync", full)
        with pytest.raises(UserError, match=r"15\.ckpt: the checkpoint cannot be written \(No space left"):
            train(tmp_path / "hit", **settings)
    assert read_training_log(tmp_path / "hit") == read_training_log(tmp_path / "whole")[:1]
    again = train(tmp_path / "hit", **settings)
    assert torch.equal(whole.net[0].weight, again.net[0].weight)
    assert read_training_log(tmp_path / "hit") == read_training_log(tmp_path / "whole")


KILLED = """
import os, sys, time
from pathlib import Path
from motionloom.pipeline.training.checkpointing import BackgroundWriter, name_of
folder = Path(sys.argv[1])
writer = BackgroundWriter(keep=2)
writer.write({"global_step": 1}, folder / name_of(1))
writer.finish()
os.fsync = lambda _: (print("writing", flush=True), time.sleep(60))
writer.write({"global_step": 2}, folder / name_of(2))
"""


def test_killed_while_it_writes(tmp_path: Path) -> None:
    """The checkpoint before is the newest, and what was being written goes with the next start."""
    command = [sys.executable, "-P", "-c", KILLED, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGKILL)
    assert len(list(tmp_path.iterdir())) == 2
    assert newest(tmp_path) == tmp_path / name_of(1)
    assert read_checkpoint(tmp_path / name_of(1))["global_step"] == 1
    remove_temporaries(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name_of(1)]
