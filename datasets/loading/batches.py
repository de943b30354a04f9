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

from motionloom.datasets.base.randomness import uniform
from motionloom.datasets.loading.crops import Crops
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.schema import UserError
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

    `windows_per_clip` windows are cut from each clip read. A clip shorter than `window` is taken whole and
    padded. A clip that holds none of the columns is never drawn; a column that no clip holds is refused.
    """

    def __init__(
        self,
        dataset: ClipDataset,
        stats: FeatureStats,
        *,
        window: int,
        batch_size: int,
        windows_per_clip: int = 1,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        columns: NDArray[np.int64] | None = None,
    ) -> None:
        if windows_per_clip < 1 or batch_size % windows_per_clip:
            raise UserError(f"batch_size {batch_size} is no multiple of windows_per_clip {windows_per_clip}")
        if window < 1:
            raise UserError(f"a window needs at least one frame, not {window}")
        self.crops = Crops(dataset, stats, columns)
        self.dataset = dataset
        self.window = window
        self.windows_per_clip = windows_per_clip
        self.seed, self.rank, self.world = seed, rank, world
        self.clips = self.crops.clips
        if len(self.clips) == 0 or not self.crops.present[np.unique(dataset.present)].any(axis=0).all():
            raise UserError(
                f"{dataset.where}: no clip of split '{dataset.split}' holds hands or a face that the chosen "
                f"part has columns for; choose another `part` or another data set"
            )
        whole = self.crops.present[np.unique(dataset.present[self.clips])].all()
        self.full = bool(whole and (dataset.frames[self.clips] >= window).all())
        sources = dataset.sources(self.clips)
        self.plan = BatchPlan(len(self.clips), batch_size // windows_per_clip, seed, sources=sources)
        self.plan.local(0, rank, world)  # an indivisible batch is refused now, not in a loader worker

    def _windows(self, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Clips [n], first frames [n, windows_per_clip] and lengths [n] of batch `k`."""
        turns, items = self.plan.local(k, self.rank, self.world)
        clips = self.clips[items]
        frames = self.dataset.frames[clips]
        numbers = np.arange(self.windows_per_clip)[None]
        draws = uniform(self.seed, _WINDOW, turns[:, None], clips[:, None], numbers)
        starts = (draws * (np.maximum(frames - self.window, 0) + 1)[:, None]).astype(np.int64)
        return clips, starts, np.minimum(frames, self.window)

    def __getitem__(self, k: int) -> MotionBatch:
        clips, starts, length = self._windows(k)
        per_clip = self.windows_per_clip
        motion = np.empty((len(clips) * per_clip, self.window, self.crops.width), dtype=np.float32)
        for row, clip in enumerate(clips.tolist()):
            for j in range(per_clip):
                self.crops.fill(motion[row * per_clip + j], clip, int(starts[row, j]), int(length[row]))
        return {
            "motion": torch.from_numpy(motion),
            "length": torch.from_numpy(np.repeat(length, per_clip)),
            "present": torch.from_numpy(self.crops.present[np.repeat(self.dataset.present[clips], per_clip)]),
            "full": self.full,
        }
