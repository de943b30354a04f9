"""Batches of windows of motion, for stages that train on motion alone."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from motionloom.datasets.loading.batches import EvalBatches, WindowBatches
from motionloom.pipeline.contract.stage import Given
from motionloom.pipeline.stages.trained import Batches


class WindowConfig(Protocol):
    """Settings of a stage that trains on windows."""

    @property
    def window(self) -> int:
        """Frames of a window."""
        ...

    @property
    def windows_per_clip(self) -> int:
        """Windows cut from one read of a clip."""
        ...


def window_batches(
    config: WindowConfig, given: Given, columns: NDArray[np.int64], seed: int, **validation: Any
) -> Batches:
    """Windows of the training split; validation on held-out clips, as `EvalBatches` takes it."""
    data, stats = given["data"], given["stats"]
    dataset = data.split("train", training=True)

    def train(batch: int, rank: int, world: int) -> Dataset[Any]:
        return WindowBatches(
            dataset,
            stats,
            window=config.window,
            batch_size=batch,
            windows_per_clip=config.windows_per_clip,
            seed=seed,
            rank=rank,
            world=world,
            columns=columns,
        )

    return Batches(train, lambda: EvalBatches(data.held_out(), stats, columns=columns, **validation))
