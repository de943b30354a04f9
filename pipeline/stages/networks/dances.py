"""Windows of clips with music, clips to begin with, and the music of a request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.loading.condition_batches import ConditionBatches, EvalBatches
from motionloom.datasets.loading.crops import Crops
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.training.trained_stage import Batches


def dance_batches(
    data: Data,
    read: Callable[[ClipDataset], FeatureStats | Crops],
    audio: FrameStats | None,
    seed: int,
    *,
    frames: Mapping[str, Any],
    test_songs: bool = False,
) -> Batches:
    """Windows of dances with their music, or without `audio` of any clips.

    Args:
        read: What normalises or reads the motion of a data set.
        frames: Lengths and columns, as `ConditionBatches` takes them.
        test_songs: Train on the test split.
    """
    readers = {} if audio is None else {"audio": audio}
    balance = {"audio": 1.0} if readers else None
    dataset = data.held_out(prefer="test") if test_songs else data.split("train", training=True)

    def train(batch: int, rank: int, world: int) -> Dataset[object]:
        return ConditionBatches(
            dataset, read(dataset), readers, batch_size=batch, balance=balance, seed=seed, rank=rank,
            world=world, **frames,
        )  # fmt: skip

    def validation() -> Dataset[object]:
        held_out = data.held_out()
        return EvalBatches(held_out, read(held_out), readers, batch_size=32, **frames)

    return Batches(train, validation)


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


def music_of(request: GenerationRequest, given: Mapping[str, Any]) -> Tensor:
    """The normalised music [B, L, E] of a request; 0 after each row's end."""
    found = request.conditions.get("audio")
    if found is None:
        raise UserError("this model dances to music, and none was given")
    return MODALITIES["audio"].normalise(given["audio"], found).features
