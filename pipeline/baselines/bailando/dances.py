"""Windows of clips as joints in metres, for networks that read positions, and the beats of their music."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.loading.condition_batches import ConditionBatch
from motionloom.datasets.loading.crops import Crops
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.features.smpl75 import SMPL_JOINTS, joints24_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.clips import ClipDataset


def danced_joints(layout: MotionLayout) -> int:
    """Joints that Bailando sees: the layout's, or of SMPL's columns SMPL's 24."""
    return SMPL_JOINTS if layout.name == "smpl75" else layout.num_joints


def joints_of_dance(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64]:
    """Return the joints [T, N, 3] of features [T, D] in their own units."""
    return joints24_of(features) if layout.name == "smpl75" else joints_of(features, layout)


class JointCrops(Crops):
    """Reads joints [T, 3 N] where `Crops` reads normalised columns; each clip starts where it starts."""

    def __init__(self, dataset: ClipDataset) -> None:
        self.dataset = dataset
        self.width = 3 * danced_joints(dataset.layout)
        self.present = np.ones((4, self.width), dtype=np.bool_)
        self.clips = np.arange(len(dataset))
        self._keep()

    def _read(self, out: NDArray[np.float32], clip: int, start: int) -> None:
        """Joints of a clip's frames from `start` on, `out` [T, 3 N]."""
        joints = joints_of_dance(self.dataset.motion(clip, 0, start + len(out)), self.dataset.layout)
        out[:] = joints[start:].reshape(len(out), -1)


class BeatBatch(ConditionBatch):
    """A batch of dances."""

    beats: Tensor
    """bool [B, T], frames with a beat of the music."""


class BeatBatches(Dataset[BeatBatch]):
    """Batches with music, and its beats.

    Args:
        stats: What the music is normalised by.
    """

    def __init__(self, batches: Dataset[ConditionBatch], stats: FrameStats, fps: float) -> None:
        self.batches = batches
        self.stats = stats
        self.fps = fps

    def __len__(self) -> int:
        return len(self.batches)  # type: ignore[arg-type]

    def __getitem__(self, k: int) -> BeatBatch:
        batch = self.batches[k]
        features, mask, _ = batch["conditions"]["audio"]
        beats = torch.zeros_like(mask)
        for row, valid in enumerate(mask):
            rows = features[row][valid].numpy() * self.stats.std + self.stats.mean
            times = MODALITIES["audio"].ticks(None, rows, self.fps) if len(rows) else []
            frames = np.round(np.array(times) * self.fps).astype(int)
            beats[row, frames[frames < len(rows)]] = True
        return {**batch, "beats": beats}
