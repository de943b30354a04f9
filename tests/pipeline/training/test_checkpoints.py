"""Checkpoint files: every tear and every flipped bit is found, and a full disk costs no checkpoint."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.base.files import HashingFile
from motionloom.datasets.schema import UserError
from motionloom.pipeline.training.checkpointing import read_checkpoint, readable, write_checkpoint

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


def test_every_tear_is_found(folder: Path) -> None:
    path = folder / "step=00000020.ckpt"
    raw = path.read_bytes()
    sizes = {0, 1, SEAL - 1, SEAL, len(raw) - SEAL - 1, len(raw) - SEAL, len(raw) - SEAL + 1, len(raw) - 1}
    sizes |= {int(size) for size in np.linspace(100, len(raw) - 100, 13)}
    assert len(sizes) >= 20
    for size in sizes:
        path.write_bytes(raw[:size])
        passed_over(folder)
    torch.save([1, 2], path)
    passed_over(folder)


def test_every_flipped_bit_is_found(folder: Path) -> None:
    path = folder / "step=00000020.ckpt"
    raw = path.read_bytes()
    rng = np.random.default_rng(0)
    places = [*rng.integers(len(raw), size=100), *range(len(raw) - SEAL, len(raw), 7), len(raw) - 1]
    silent = 0
    for place in places:
        flipped = bytearray(raw)
        flipped[place] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        passed_over(folder)
        if place < len(raw) - SEAL:
            try:
                torch.load(path, weights_only=True)
            except Exception:  # whatever torch finds
                continue
            silent += 1
    assert silent > 50, "torch finds them by itself: the seal is not needed any more"


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
        with pytest.raises(UserError, match=r"30\.ckpt: the checkpoint cannot be written \(No space left"):
            write_checkpoint(CONTENT, new)
        # Nor is one of the same name touched: a passed-over checkpoint is written again.
        with pytest.raises(UserError, match=r"20\.ckpt: the checkpoint cannot be written"):
            write_checkpoint(CONTENT, folder / "step=00000020.ckpt")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    write_checkpoint(CONTENT, new)
    assert next(readable(folder))[0] == new
