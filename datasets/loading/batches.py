"""Batches for training: map-style datasets whose item `k` is one rank's whole share of global step `k`.

`Steps` goes through them for a loader; a run resumes by starting elsewhere. What a batch holds depends on
the data, its order and (seed, k) alone; the ranks' shares one after the other are the global batch whatever
their number. `batch_size` is always the *global* one.
"""

from __future__ import annotations

from typing import NotRequired, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.loading.crops import Crops
from motionloom.datasets.loading.plan import ALONE, BatchPlan, Share
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.shards.clips import ClipDataset

_WINDOW = 1
"""Keeps the draws apart from those for other purposes (`condition_batches.py`)."""


class MotionBatch(TypedDict):
    """`motion` float32 [B, T, C], normalised, zero after `length` int64 [B] and where `present` is false."""

    motion: Tensor
    length: Tensor
    present: Tensor
    """bool [B, C]: columns of parts (hands, face) that the clip holds. The others must not be learnt from."""
    full: NotRequired[bool]
    """Every frame and column of *all* batches is real, so nothing has to be masked."""


class WindowBatches(Dataset[MotionBatch]):
    """Fixed windows for the tokenizers (HumanTOMATO appendix C, T2M-GPT's 64 frames).

    A clip shorter than `window` is taken whole and padded. A clip that holds none of the columns is never
    drawn; a column that no clip holds is refused.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        *,
        window: int,
        batch_size: int,
        seed: int = 0,
        share: Share = ALONE,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        if window < 1:
            raise UserError(f"a window needs at least one frame, not {window}")
        self.crops = Crops(dataset, stats, columns)
        self.dataset = dataset
        self.window = window
        self.seed = seed
        self.share = share
        self.clips = self.crops.clips
        if len(self.clips) == 0 or not self.crops.present[np.unique(dataset.present)].any(axis=0).all():
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' holds hands or a face that the chosen "
                f"part has columns for; choose another `part` or another data set"
            )
        whole = self.crops.present[np.unique(dataset.present[self.clips])].all()
        self.full = bool(whole and (dataset.frames[self.clips] >= window).all())
        sources = dataset.sources(self.clips)
        self.plan = BatchPlan(len(self.clips), batch_size, seed, sources=sources)
        self.plan.local(0, self.share)  # an indivisible batch is refused now, not in a loader worker

    def _windows(self, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Clips, first frames and lengths of batch `k`, each [n]."""
        turns, items = self.plan.local(k, self.share)
        clips = self.clips[items]
        coming = self.plan.local(k + self.plan.ahead * self.share.parts, self.share)[1]
        self.dataset.fetch(np.concatenate([clips, self.clips[coming]]))
        frames = self.dataset.frames[clips]
        draws = uniform(self.seed, _WINDOW, turns, clips, 0)
        starts = (draws * (np.maximum(frames - self.window, 0) + 1)).astype(np.int64)
        return clips, starts, np.minimum(frames, self.window)

    def __getitem__(self, k: int) -> MotionBatch:
        clips, starts, length = self._windows(k)
        motion = np.empty((len(clips), self.window, self.crops.width), dtype=np.float32)
        for row, clip in enumerate(clips.tolist()):
            self.crops.fill(motion[row], clip, int(starts[row]), int(length[row]))
        return {
            "motion": torch.from_numpy(motion),
            "length": torch.from_numpy(length),
            "present": torch.from_numpy(self.crops.present[self.dataset.present[clips]]),
            "full": self.full,
        }
