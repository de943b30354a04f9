"""A stage's curves and figures for the report, and its sizes for a dry run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.skeleton import Skeleton


@dataclass(frozen=True)
class Curve:
    """One plot: every logged value whose name begins with `prefix`, training and validation."""

    prefix: str
    title: str = ""
    """Title after the stage's name; empty: the prefix."""


class Showing(Protocol):
    """Something the report can draw."""

    @property
    def title(self) -> str:
        """Return the curve's title."""
        ...


@dataclass(frozen=True)
class Bars:
    """A bar chart."""

    title: str
    values: NDArray[np.float64] | NDArray[np.int64]
    x_label: str
    y_label: str


@dataclass(frozen=True)
class JointErrors:
    """The error of each joint of a human figure."""

    title: str
    skeleton: Skeleton
    errors: Mapping[str, float]
    """mm by the joint's name; joints that no clip has are left out."""


@dataclass(frozen=True)
class Confusions:
    """How often one thing was shown where another was asked for."""

    title: str
    counts: Mapping[str, Mapping[str, int]]
    """Asked for -> shown -> clips."""


@dataclass(frozen=True)
class FigureTable:
    """A table of figures."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class ModelCard:
    """Sizes of a stage that trains, computed without any data."""

    parameters: int
    codebook: int
    """Values of codebooks that learn by averages and have no gradient."""
    batch: int
    """Items of a step."""
    local_batch: int
    """Items of the batch that a process takes at once."""
    memory_bytes: int
    note: str
    """Its tokens, in words."""
    steps: int
    checkpoint_bytes: int
    """Bytes of all checkpoints that are kept at a time."""
