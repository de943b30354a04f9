"""A table that is filled in: what every writer takes, free of any form."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
        section = self.section if self.section.startswith("appendix") else f"section {self.section}"
        return f"{self.paper}: {self.title} ({section})"


ARROWS = {"lower": " ↓", "higher": " ↑", None: ""}

_LONG = 40
"""What the paper's measuring is called in more letters is not repeated with every difference."""


def heading(head: Head) -> str:
    """A column's name with its unit and the direction of better."""
    unit = f" ({head.unit})" if head.unit else ""
    return f"{head.name}{unit}{ARROWS[head.better]}"


def groups(heads: Sequence[Head]) -> list[tuple[str, int]]:
    """(title, columns) of neighbouring columns of one group, in order; none where no column has a group."""
    out: list[tuple[str, int]] = []
    for head in heads:
        if out and out[-1][0] == head.group:
            out[-1] = (head.group, out[-1][1] + 1)
        else:
            out.append((head.group, 1))
    return out if any(title for title, _ in out) else []


def who(row: FilledRow) -> str:
    """Whose row it is, in one word."""
    return {"paper": "paper", "ours": "ours", "missing": "ours", "reference": "no model"}[row.source]


def lines_below(table: FilledTable) -> Iterator[str]:
    """Notes, then what was measured otherwise, one line for each evaluation."""
    yield from table.notes
    if alone := [head.title for head in table.heads if not head.printed]:
        yield f"{', '.join(alone)}: not in the paper, a figure of ours alone."
    found: dict[tuple[str, str], list[str]] = {}
    for one in table.differences:
        theirs = "the paper does not say" if one.paper is None else f"paper: {one.paper}"
        if one.paper is not None and len(one.paper) > _LONG and one.paper in table.measured.values():
            theirs = "paper: see above"
        found.setdefault((one.run, one.evaluation), []).append(f"{one.what} {one.ours} ({theirs})")
    for (run, evaluation), said in found.items():
        yield f"{run} {evaluation}: {'; '.join(said)}"
