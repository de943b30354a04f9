"""Windows of clips with their music."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.contract.stage import Inputs
from motionloom.pipeline.store.data import Data
from pacer.network import PART


class PacerInputs(Inputs):
    """What it takes: a role for each attribute."""

    data: Data
    stats: FeatureStats
    audio: FrameStats


class PacerBatch(TypedDict):
    """Windows of motion and the music that goes with them, frame for frame."""

    motion: Tensor
    """[B, window, D]"""
    audio: Tensor
    """[B, window, A]"""
    length: Tensor
    """[B]; all the window. A module counts the rows of a validation batch by it."""


class PacerBatches(Dataset[PacerBatch]):
    """Item k is one rank's rows of global batch k: a pure function of (data, seed, k), so runs resume."""

    def __init__(
        self, data: ClipDataset, inputs: PacerInputs, window: int, batch: int, seed: int, *at: int
    ) -> None:
        self.data, self.window, self.seed = data, window, seed
        self.at = at or (0, 1)  # rank, and number of ranks
        self.stats, self.audio = inputs.stats, inputs.audio
        self.columns = data.layout.part(PART)
        self.clips = np.flatnonzero(data.has("audio.npy") & (data.frames >= window))
        if not len(self.clips):
            raise UserError(f"{data.where}: no clip of split '{data.split}' has music and {window} frames")
        self.plan = BatchPlan(len(self.clips), batch, seed)

    def __len__(self) -> int:
        return self.plan.batches_per_epoch  # of validation; training asks for as many as it has steps

    def __getitem__(self, k: int) -> PacerBatch:
        turns, items = self.plan.local(k, *self.at)
        clips, draws = self.clips[items], uniform(self.seed, turns, self.clips[items])
        begins = (draws * (self.data.frames[clips] - self.window + 1)).astype(np.int64)
        motion, audio = [], []
        for clip, begin in zip(clips.tolist(), begins.tolist(), strict=True):
            rows, heard = slice(begin, begin + self.window), self.data.array(clip, "audio.npy")
            assert heard is not None
            motion.append(self.stats.normalize(self.data.motion(clip)[rows][:, self.columns], self.columns))
            audio.append(self.audio.normalize(heard[rows]))
        both = torch.from_numpy(np.stack(motion)), torch.from_numpy(np.stack(audio))
        return {"motion": both[0], "audio": both[1], "length": torch.full((len(clips),), self.window)}
