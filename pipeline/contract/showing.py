"""What a stage has to show in the report: curves of its training log, and figures of what it made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Curve:
    """One plot: every logged value whose name begins with `prefix`, training and validation."""

    prefix: str
    title: str = ""
    """Shown behind the stage's name; the prefix when empty."""


class Showing(Protocol):
    """Something the report can draw."""

    title: str


@dataclass(frozen=True)
class Bars:
    """A bar chart."""

    title: str
    values: NDArray[np.float64] | NDArray[np.int64]
    x_label: str
    y_label: str


@dataclass(frozen=True)
class FigureTable:
    """A table of figures."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
