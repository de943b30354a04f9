"""Figures of a run on held-out clips, each beside its trivial answer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import PRESENT_ALL
from motionloom.datasets.synth.measure import agrees
from motionloom.models.metrics.physics import SHORTEST, physics
from motionloom.models.metrics.retrieval import recall
from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation.truth import Truth


@dataclass(frozen=True)
class Interval:
    """Mean and half-width of the 95 % interval over repetitions."""

    mean: float
    half_width: float

    @staticmethod
    def of(values: Sequence[float]) -> Interval:
        """Of repeated measurements."""
        array = np.asarray(values, dtype=np.float64)
        half = 1.96 * array.std(ddof=1) / np.sqrt(len(array)) if len(array) > 1 else 0.0
        return Interval(float(array.mean()), float(half))


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


def retrieval_figures(
    text: Tensor, motion: Tensor, *, size: int, repeats: int, seed: int
) -> dict[str, Interval]:
    """Recall@1/2/3 both ways among `size` (protocols C and D): mean over batches, interval over repeats."""
    rows: dict[str, list[float]] = {}
    for repeat in range(repeats):
        for name, value in recall(
            text, motion, batch=size, recalls=(1, 2, 3), seed=seed * 1000 + repeat
        ).items():
            if "/R@" in name:
                rows.setdefault(name.replace("/R@", "_r"), []).append(value)
    return {name: Interval.of(values) for name, values in rows.items()}


def chance(k: int, size: int) -> float:
    """Recall@k of a guess."""
    return k / size


def obeyed(truth: Truth, joints: NDArray[np.float64], face: NDArray[np.float32] | None, fps: float) -> Row:
    """1 or 0 for each attribute of a clip's caption that can be measured: whether a motion does it; and for
    "everything" together. Only clips of the synthetic source know what they really do; others have nothing.
    """
    if truth.truth is None:
        return {}
    found = agrees(truth.truth, joints, face, fps)
    return {name: float(value) for name, value in (found | {"everything": all(found.values())}).items()}


def bodily(joints: NDArray[np.float64], fps: float) -> Row:
    """Skating, floating, penetration and jitter of a motion [T, N, 3]; of one too short for them nothing."""
    return physics(joints, fps)._asdict() if len(joints) >= SHORTEST else {}


def shares(rows: Iterable[Row]) -> Row:
    """Mean of each figure over the rows that have it."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            values.setdefault(name, []).append(value)
    return {name: float(np.mean(found)) for name, found in values.items()}
