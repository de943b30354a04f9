"""Two trainings that must have ended alike: bit for bit, or on two ranks as on one within a bound."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.store.training_log import read_training_log


def newest(folder: Path) -> dict[str, Any]:
    """What training goes on from, without the clock and the paths in it."""
    path = max((folder / "checkpoints").iterdir())
    checkpoint: dict[str, Any] = torch.load(path, weights_only=True)
    kept = ("global_step", "state_dict", "optimizer_states", "average", "row", "validate")
    return {**{name: checkpoint[name] for name in kept}, "rows": checkpoint["log"]["rows"]}


def assert_equal(one: Any, two: Any, where: str = "") -> None:
    """Bit for bit, through all levels."""
    if isinstance(one, Tensor):
        assert torch.equal(one, two), where
    elif isinstance(one, dict):
        assert one.keys() == two.keys(), where
        for name in one:
            assert_equal(one[name], two[name], f"{where}.{name}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(two), where
        for index, pair in enumerate(zip(one, two, strict=True)):
            assert_equal(*pair, f"{where}[{index}]")
    else:
        assert one == two, where


def assert_same_stage(one: Path, two: Path, first: StageModule, second: StageModule) -> None:
    """The same saved weights, checkpoint and log."""
    assert_equal(first.state_dict(), second.state_dict())
    assert_equal(newest(one), newest(two))
    assert read_training_log(one) == read_training_log(two)


def assert_kills_change_nothing(
    train: Callable[..., StageModule], folder: Path, deaths: Sequence[int], reached: int, **settings: Any
) -> None:
    """A training killed at `deaths`, with its newest checkpoint at `reached`, ends as an undisturbed one."""
    whole = train(folder / "whole", **settings)
    for step in deaths:
        with pytest.raises(ConnectionResetError):
            train(folder / "killed", dies_at=step, **settings)
    assert newest(folder / "killed")["global_step"] == reached
    again = train(folder / "killed", **settings)
    assert_same_stage(folder / "whole", folder / "killed", whole, again)


def _meant(name: str, value: Tensor) -> Tensor:
    """Without the keys' biases: they change no softmax, so their gradients are rounding, which Adam makes
    whole steps of.
    """
    if not name.endswith("qkv.bias"):
        return value
    query, _, values = value.chunk(3)
    return torch.cat([query, values])


def assert_ranks_equal_one(one: StageModule, folder: Path, pair: Path, name: str, bound: float) -> None:
    """Weights ("NAME-RANK.pt") and log (NAME) of two ranks in `pair`, and of one process in `folder`."""
    first, second = (torch.load(pair / f"{name}-{rank}.pt", weights_only=True) for rank in range(2))
    assert_equal(first, second)
    for key, value in one.state_dict().items():
        near, far = _meant(key, first[key]), _meant(key, value)
        torch.testing.assert_close(near, far, rtol=bound, atol=bound, msg=lambda m, k=key: f"{k}: {m}")
    rows = [read_training_log(where) for where in (folder, pair / name)]
    assert [sorted(row) for row in rows[0]] == [sorted(row) for row in rows[1]]
    for row, other in zip(*rows, strict=True):
        assert other == pytest.approx(row, rel=1e-5, abs=1e-5)
