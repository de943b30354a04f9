"""Figures of a run on held-out clips, each beside its trivial answer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

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
