"""Latents of motions, by whatever embeds them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import PRESENT_ALL


class MotionJudge(Protocol):
    """What embeds motions: an alignment model (TMA, TEMOS) or an evaluator."""

    @property
    def layout(self) -> MotionLayout:
        """Layout of whole frames."""
        ...

    @property
    def part(self) -> Part:
        """The columns that it reads."""
        ...

    @property
    def stats(self) -> FeatureStats:
        """Mean and deviation of its motion."""
        ...

    @property
    def max_frames(self) -> int:
        """Longer motions are cut to this."""
        ...

    def embed_motion(self, motion: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        """Latents [B, Z] of normalised features [B, T, D]."""
        ...


def embed_motions(
    judge: MotionJudge,
    motions: Sequence[NDArray[np.float32]],
    present: Sequence[int] | None = None,
    batch: int = 64,
) -> Tensor:
    """Latents [n, Z] of body-hand features, by TMA or an evaluator; longer motions are cut at its length.

    `present` [n]: what each holds (all when None); the rest is 0, the mean, as in training.
    """
    columns = judge.layout.part(judge.part)
    mean, std = judge.stats.mean[columns], judge.stats.std[columns]
    order = np.argsort([len(m) for m in motions], kind="stable")
    masks = judge.layout.present_columns[:, columns][
        [PRESENT_ALL] * len(motions) if present is None else present
    ]
    out: dict[int, Tensor] = {}
    for start in range(0, len(order), batch):
        rows = order[start : start + batch].tolist()
        cut = [(motions[i][: judge.max_frames] - mean) / std for i in rows]
        length = torch.tensor([len(m) for m in cut])
        motion = torch.zeros(len(cut), int(length.max()), len(columns))
        for row, values in enumerate(cut):
            motion[row, : len(values)] = torch.from_numpy(values.astype(np.float32))
        near = torch.from_numpy(masks[rows])
        for i, latent in zip(rows, judge.embed_motion(motion, length, near).cpu(), strict=True):
            out[i] = latent
    return torch.stack([out[i] for i in range(len(motions))])
