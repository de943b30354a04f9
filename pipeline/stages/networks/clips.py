"""Batches of clips with their conditions, and dances to begin with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.pipeline.training.trained_stage import Batches

if TYPE_CHECKING:
    from motionloom.datasets.loading.crops import Crops
    from motionloom.datasets.loading.plan import Share
    from motionloom.datasets.loading.statistics import FeatureStats
    from motionloom.datasets.shards.clips import ClipDataset
    from motionloom.models.training.stage_module import Batch
    from motionloom.pipeline.store.data import Data
    from motionloom.pipeline.training.config import SizedBatches


MUSIC = {"audio": 1.0}
"""Balance of trainings on dances: clips with music alone."""


def clip_batches(
    data: Data,
    read: FeatureStats | Callable[[ClipDataset], Crops],
    readers: Mapping[str, object],
    seed: int,
    *,
    clips: Mapping[str, Any],
    dataset: ClipDataset | None = None,
    **draws: Any,
) -> Batches:
    """Batches of windows or whole clips, and of held-out ones in order.

    Args:
        read: What normalises the motion of a data set, or makes the reader of it.
        readers: What reads the conditions, by modality.
        clips: Lengths, columns and kind of captions, as `ConditionBatches` takes them.
        dataset: Trained on in place of the training split.
        draws: How clips are drawn in training alone.
    """
    from motionloom.datasets.loading.condition_batches import ConditionBatches, EvalBatches

    dataset = data.split("train") if dataset is None else dataset

    def of(some: ClipDataset) -> FeatureStats | Crops:
        return read(some) if callable(read) else read

    def train(batch: int, share: Share) -> Dataset[object]:
        return ConditionBatches(
            dataset, of(dataset), readers, seed=seed, batch_size=batch, share=share, **clips, **draws
        )

    def validation() -> SizedBatches:
        held_out = data.held_out()
        return EvalBatches(held_out, of(held_out), readers, batch_size=32, **clips)

    return Batches(train, validation)


def motion_example(batch: int, frames: int, columns: int, **more: object) -> Batch:
    """Return a batch of motion of the largest shape, [B, T, D] without numbers, and `more`."""
    motion = torch.empty(batch, frames, columns)
    return {"motion": motion, "length": torch.full((batch,), frames), **more}


def spread_dances(dataset: ClipDataset, count: int, least: int) -> list[int]:
    """`count` clips with music and `least` frames, evenly spread; repeated where there are fewer."""
    found = np.flatnonzero(dataset.has(MODALITIES["audio"].members[0]) & (dataset.frames >= least))
    if not len(found):
        raise UserError(
            f"{dataset.where}: no clip with music of split '{dataset.split}' has {least} frames; lower the "
            f"lengths in net, or take other data"
        )
    rows: list[int] = found[np.linspace(0, len(found) - 1, count).round().astype(int)].tolist()
    return rows
