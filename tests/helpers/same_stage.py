"""Two trainings that must have ended alike: bit for bit, in their weights, checkpoints and logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
