"""Checkpoint files: every tear and flipped bit is found, a full disk costs none, and what is written beside a
training is of the moment it was asked for.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from same_stage import assert_equal, assert_same_stage
from tiny_adversaries import train
from ude_training import train as train_ude

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import HashingFile, remove_temporaries
from motionloom.models.training import compiled
from motionloom.pipeline.launch.process import Interrupted
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.training.checkpointing import (
    BackgroundWriter,
    name_of,
    read_checkpoint,
    readable,
    step_of,
    write_checkpoint,
)

SEAL = 84
CONTENT = {
    "state_dict": {"net.weight": torch.randn(32, 32), "net.bias": torch.arange(32.0)},
    "optimizer_states": [{"state": {0: {"exp_avg": torch.randn(32, 32).double()}}}],
    "global_step": 20,
    "loops": {"fit_loop": {"epoch": 2}},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Checkpoints of steps 10 and 20."""
    for step in (10, 20):
        write_checkpoint({**CONTENT, "global_step": step}, tmp_path / f"step={step:08d}.ckpt")
    return tmp_path


def passed_over(folder: Path) -> str:
    """Why the newest checkpoint is not used; the one before it must be, with its own content."""
    said: list[str] = []
    path, content = next(readable(folder, said.append))
    assert path == folder / "step=00000010.ckpt" and content["global_step"] == 10
    assert len(said) == 1 and said[0].startswith(f"{folder / 'step=00000020.ckpt'}: ")
    return said[0]


def test_what_is_written_comes_back(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["step=00000010.ckpt", "step=00000020.ckpt"]
    path = folder / "step=00000020.ckpt"
    raw = path.read_bytes()
    digest = hashlib.sha256(raw[:-SEAL]).hexdigest()
    assert raw[-SEAL:] == f"\nmotionloom sha256 {digest}\n".encode()
    for content in (read_checkpoint(path), torch.load(path, weights_only=True)):
        assert content["global_step"] == 20
        for name, value in CONTENT["state_dict"].items():  # type: ignore[attr-defined]
            assert torch.equal(content["state_dict"][name], value)


def test_every_tear_and_flipped_bit_is_found(folder: Path) -> None:
    path, rng = folder / "step=00000020.ckpt", np.random.default_rng(0)
    raw = path.read_bytes()
    sizes = {0, 1, SEAL - 1, SEAL, *range(len(raw) - SEAL - 1, len(raw) - SEAL + 2), len(raw) - 1}
    for size in sizes | {int(size) for size in np.linspace(100, len(raw) - 100, 13)}:
        path.write_bytes(raw[:size])
        passed_over(folder)
    torch.save([1, 2], path)
    passed_over(folder)
    for place in [*rng.integers(len(raw), size=100), *range(len(raw) - SEAL, len(raw), 7), len(raw) - 1]:
        flipped = bytearray(raw)
        flipped[place] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        passed_over(folder)


def full(*_: Any) -> None:
    """What the system says."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def fails_at(byte: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk be full from that byte of a file on."""
    written = 0
    write = HashingFile.write

    def limited(self: HashingFile, data: bytes) -> int:
        nonlocal written
        written += len(data)
        if written > byte:
            full()
        return write(self, data)

    monkeypatch.setattr(HashingFile, "write", limited)


Failure = Callable[[pytest.MonkeyPatch], None]
FAILURES: dict[str, Failure] = {
    **{f"byte {byte}": lambda patch, byte=byte: fails_at(byte, patch) for byte in (0, 100, 3000, 12000)},
    "fsync": lambda patch: patch.setattr(os, "fsync", full),
    "rename": lambda patch: patch.setattr(Path, "replace", full),
}


@pytest.mark.parametrize("failure", FAILURES.values(), ids=FAILURES.keys())
def test_a_full_disk_leaves_the_previous_checkpoints(
    failure: Failure, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    new = folder / "step=00000030.ckpt"
    with monkeypatch.context() as patch:
        failure(patch)
        with pytest.raises(UserError, match=r"30\.ckpt: .*No space left"):
            write_checkpoint(CONTENT, new)
        # Nor is one of the same name touched: a passed-over checkpoint is written again.
        with pytest.raises(UserError, match=r"20\.ckpt: "):
            write_checkpoint(CONTENT, folder / "step=00000020.ckpt")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    write_checkpoint(CONTENT, new)
    assert next(readable(folder))[0] == new


def state() -> dict[str, Any]:
    """What trainings have: views, empty tensors, state of optimizers by number."""
    table = torch.arange(20.0).reshape(4, 5)
    states = [{"state": {0: {"exp_avg": table[1]}}, "b": (0, torch.empty(0))}]
    return {"state_dict": {"table": table}, "optimizer_states": states, "global_step": 7}


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
    trained["state_dict"]["table"].zero_()
    trained["optimizer_states"].clear()
    assert writer.busy and not (tmp_path / name_of(7)).exists()
    threading.Timer(0.2, go.set).start()
    writer.write({"global_step": 14}, tmp_path / name_of(14))
    assert (tmp_path / name_of(7)).exists()
    writer.finish()
    assert not writer.busy and next(readable(tmp_path))[0] == tmp_path / name_of(14)
    assert_equal(dict(read_checkpoint(tmp_path / name_of(7))), state())


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


def test_a_full_disk_ends_a_training_with_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The log on disk is that of the checkpoint before, and the same command goes on from it."""
    settings: dict[str, Any] = {"checkpoint_every": 5, "validate_every": 0}
    whole = train(tmp_path / "whole", **settings)
    with monkeypatch.context() as patch:
        synced = os.fsync

        def limited(handle: int) -> None:
            if name_of(15) in str(Path(f"/proc/self/fd/{handle}").readlink()):
                full()
            synced(handle)

        patch.setattr(os, "fsync", limited)
        with pytest.raises(UserError, match=r"15\.ckpt: .*No space left"):
            train(tmp_path / "hit", **settings)
    assert read_training_log(tmp_path / "hit") == read_training_log(tmp_path / "whole")[:1]
    jumps = itertools.count()  # the clock goes back and ahead by hours
    monkeypatch.setattr(time, "time", lambda: 1e9 + 1e4 * (-1) ** next(jumps))
    again = train(tmp_path / "hit", **settings)
    assert torch.equal(whole.net[0].weight, again.net[0].weight)
    assert read_training_log(tmp_path / "hit") == read_training_log(tmp_path / "whole")


@pytest.mark.parametrize("ask", ["write", "finish"])
def test_an_error_comes_out_where_the_training_asks_next(
    ask: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = BackgroundWriter(keep=2)
    for step in (1, 2):
        writer.write({"global_step": step}, tmp_path / name_of(step))
    writer.finish()

    monkeypatch.setattr(os, "fsync", full)
    writer.write({"global_step": 3}, tmp_path / name_of(3))
    while writer.busy:
        time.sleep(0.001)
    with pytest.raises(UserError, match=r"3\.ckpt: .*No space left"):
        writer.write({}, tmp_path / name_of(4)) if ask == "write" else getattr(writer, ask)()
    assert sorted(path.name for path in tmp_path.iterdir()) == [name_of(1), name_of(2)]
    writer.finish()  # once


def write_and_hang(folder: Path, begun: Any) -> None:
    """Write a checkpoint, and begin another that never ends."""
    writer = BackgroundWriter(keep=2)
    writer.write({"global_step": 1}, folder / name_of(1))
    writer.finish()
    os.fsync = lambda _: (begun.set(), time.sleep(60))  # type: ignore[assignment,return-value]
    writer.write({"global_step": 2}, folder / name_of(2))


def test_killed_while_it_writes(tmp_path: Path) -> None:
    """The checkpoint before is the newest, and what was being written goes with the next start."""
    context = multiprocessing.get_context("fork")  # torch is imported already
    begun = context.Event()
    process = context.Process(target=write_and_hang, args=(tmp_path, begun))
    process.start()
    assert begun.wait(30)
    process.kill()
    process.join()
    assert len(list(tmp_path.iterdir())) == 2
    assert next(readable(tmp_path, print))[0] == tmp_path / name_of(1)
    assert read_checkpoint(tmp_path / name_of(1))["global_step"] == 1
    remove_temporaries(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name_of(1)]


# Trainings whose losses torch compiles: signals, failures, graphs that are kept.


Backend = str | Callable[[Any, Any], Any]


@pytest.fixture
def compile_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[Backend], None]:
    """`compile_by(backend)`: torch compiles by it, from the first graph on."""
    compiler = torch.compile

    def put(backend: Backend) -> None:
        monkeypatch.setattr(
            torch, "compile", lambda losses, **_: compiler(losses, backend=backend, fullgraph=True)
        )
        monkeypatch.setattr(compiled.Compiled, "_structure", "")

    return put


@pytest.mark.slow
@pytest.mark.parametrize(("graph", "ends_at"), [(1, 0), (2, 2)])
def test_a_signal_while_it_compiles(
    graph: int, ends_at: int, compile_by: Callable[[Backend], None], tmp_path: Path
) -> None:
    """At once where no step would be lost, else after the step, which is saved. The second graph is that of
    the second step: the first one has filled the codebook."""
    begun, ended = [], []

    def slow(graph_module: Any, inputs: Any) -> Any:
        begun.append(1)
        if len(begun) == graph:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.2)
        ended.append(1)
        return graph_module

    compile_by(slow)
    with pytest.raises(Interrupted) as stopped:
        train_ude("mq", tmp_path / "hit", compile=True)
    assert stopped.value.step == ends_at and len(begun) == graph
    assert len(ended) == (0 if ends_at == 0 else graph)
    again = train_ude("mq", tmp_path / "hit", compile=True)
    compile_by(lambda graph_module, inputs: graph_module)
    assert_same_stage(
        tmp_path / "whole", tmp_path / "hit", train_ude("mq", tmp_path / "whole", compile=True), again
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mq", "utt"])
def test_what_cannot_be_compiled_is_trained_without(
    name: str, compile_by: Callable[[Backend], None], tmp_path: Path
) -> None:
    """With one warning, and the bytes of a training that was never compiled."""

    def broken(graph_module: Any, inputs: Any) -> Any:
        torch.rand(3)  # draws of the compiler must not count
        raise ArithmeticError("no kernel for this")

    compile_by(broken)
    plain = train_ude(name, tmp_path / "plain", dropout=0.1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        module = train_ude(name, tmp_path / "failed", dropout=0.1, compile=True)
    (only,) = [str(one.message) for one in said if "torch.compile" in str(one.message)]
    assert "no kernel for this" in only
    for key, value in module.state_dict().items():
        assert torch.equal(value, plain.state_dict()[key]), key


@pytest.mark.slow
def test_graphs_are_kept_for_the_same_network(compile_by: Callable[[Backend], None], tmp_path: Path) -> None:
    made = []

    def counting(graph_module: Any, inputs: Any) -> Any:
        made.append(1)
        return graph_module

    compile_by(counting)
    counts = []
    for folder, name in enumerate(("dmd", "dmd", "mq", "dmd")):
        train_ude(name, tmp_path / str(folder), dropout=0.1, compile=True)
        counts.append(len(made))
    first, again, other, back = counts
    assert again == first > 0, "the same network needs no new graph"
    assert back - other == first, "those of another network are dropped"
