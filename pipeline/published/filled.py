"""A table that is filled in: what every writer takes, free of any form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

Source = Literal["paper", "ours", "missing", "reference"]
"""The paper's row; a model of ours; no model of ours; an answer that needs none."""


@dataclass(frozen=True)
class Head:
    """A column's heading."""

    group: str
    name: str
    unit: str
    better: Literal["lower", "higher"] | None
    printed: bool
    """Whether the paper has it."""

    @property
    def title(self) -> str:
        """Group, name and unit in one."""
        unit = f" ({self.unit})" if self.unit else ""
        return f"{self.group} {self.name}".strip() + unit


@dataclass(frozen=True)
class Cell:
    """A number."""

    text: str
    mean: float
    spread: float | None = None
    best: bool = False


@dataclass(frozen=True)
class FilledRow:
    """A row of the paper, of a model of ours, or of an answer that needs none."""

    source: Source
    method: str
    """The paper's row that it belongs to; empty of an answer that belongs to all."""
    label: str
    """What the row is: the paper's method, a run's stage, an answer."""
    cells: tuple[Cell | None, ...]
    run: str = ""
    stages: tuple[str, ...] = ()
    """Of a model: its stage, or one for each setting."""
    evaluations: tuple[str, ...] = ()
    alike: tuple[str | None, ...] = ()
    """By cell: rows whose words here are equal were measured alike."""

    def marked(self, best: set[int]) -> FilledRow:
        """With the cells of these columns marked as the best."""
        cells = tuple(
            None if cell is None else replace(cell, best=at in best) for at, cell in enumerate(self.cells)
        )
        return replace(self, cells=cells)


@dataclass(frozen=True)
class Difference:
    """One thing that was measured otherwise than in the paper."""

    run: str
    evaluation: str
    what: str
    ours: str
    paper: str | None
    """None where the paper does not say."""


@dataclass(frozen=True)
class FilledTable:
    """All of it."""

    name: str
    paper: str
    title: str
    section: str
    measured: Mapping[str, str]
    heads: tuple[Head, ...]
    rows: tuple[FilledRow, ...]
    differences: tuple[Difference, ...] = ()
    notes: tuple[str, ...] = field(default=())

    @property
    def caption(self) -> str:
        """Number and title."""
        section = self.section if self.section.startswith("appendix") else f"section {self.section}"
        return f"{self.paper}: {self.title} ({section})"
