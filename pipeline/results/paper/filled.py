"""A table that is filled in, as Markdown and as a table for terminals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.results.paper.schema import Column, PaperTable

Source = Literal["paper", "ours", "missing", "reference"]
"""The paper's row; a model of ours; no model of ours; an answer that needs none."""

_WHO = {"paper": "paper", "ours": "ours", "missing": "ours", "reference": "no model"}
_PAPERS = {"humantomato": "HumanTOMATO", "ude": "UDE"}
_ARROWS = {"lower": " ↓", "higher": " ↑", None: ""}
_LONG = 40
"""A longer description of the paper's protocol is not repeated with every difference."""


@dataclass(frozen=True)
class Cell:
    """A number of the paper or of ours as it is printed."""

    text: str
    mean: float
    spread: float | None = None
    alike: str = ""
    """Key of the protocol of a figure of ours: figures with equal keys were measured alike."""
    best: bool = False


@dataclass(frozen=True)
class FilledRow:
    """A row of the paper, of a model of ours, or of an answer that needs none."""

    source: Source
    method: str
    """The paper's row that it belongs to; empty of an answer that belongs to all."""
    label: str
    """The paper's method, the stage of a run, or a reference baseline."""
    cells: tuple[Cell | None, ...]
    run: str = ""
    stages: tuple[str, ...] = ()
    """Stages of a model: one, or one for each setting."""
    evaluations: tuple[str, ...] = ()

    def marked(self, best: set[int]) -> FilledRow:
        """With the cells of these columns marked as the best."""
        cells = [cell and replace(cell, best=at in best) for at, cell in enumerate(self.cells)]
        return replace(self, cells=tuple(cells))


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
    """A paper's table with rows of runs."""

    name: str
    table: PaperTable
    rows: tuple[FilledRow, ...]
    differences: tuple[Difference, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def caption(self) -> str:
        paper, _, number = self.name.partition("/")
        title = f"{_PAPERS.get(paper, paper)} Table {number}" if number else self.name
        section = self.table.section
        section = section if section.startswith("appendix") else f"section {section}"
        return f"{title}: {self.table.title} ({section})"

    def lines_below(self) -> Iterator[str]:
        """Notes, then what was measured otherwise, one line for each evaluation."""
        yield from self.notes
        if alone := [_heading(column, arrow=False) for column in self.table.columns if not column.printed]:
            yield f"{', '.join(alone)}: not in the paper, a figure of ours alone."
        protocol = self.table.measured.dump().values()
        lines: dict[tuple[str, str], list[str]] = {}
        for one in self.differences:
            theirs = "the paper does not say" if one.paper is None else f"paper: {one.paper}"
            if one.paper is not None and len(one.paper) > _LONG and one.paper in protocol:
                theirs = "paper: see above"
            lines.setdefault((one.run, one.evaluation), []).append(f"{one.what} {one.ours} ({theirs})")
        for (run, evaluation), parts in lines.items():
            yield f"{run} {evaluation}: {'; '.join(parts)}"

    def markdown(self) -> str:
        """A pipe table, the best figures bold, and what is to be known as a list below."""
        names = [_plain(_heading(column)) for column in self.table.columns]
        rows = [["", "", *names], ["---", "---", *("---:" for _ in names)]]
        for row in self.rows:
            cells = [_marked(cell, "**", "**") for cell in row.cells]
            rows.append([_plain(row.label), _WHO[row.source], *cells])
        body = [f"| {' | '.join(row)} |" for row in rows]
        below = [f"- {_plain(line)}" for line in self.lines_below()]
        return "\n".join([f"**{_plain(self.caption)}**", "", *body, "", *below, ""])

    def print(self, console: Console) -> None:
        """The table on a console: the best figures with a star, ours below the paper's."""
        grid = Table(title=escape(self.caption), title_justify="left", box=SIMPLE_HEAD)
        grid.add_column("", overflow="fold")
        for column in self.table.columns:
            grid.add_column(escape(_heading(column, "\n")), justify="right", overflow="fold")
        for row in self.rows:
            indent = "" if row.source in ("paper", "reference") else "  "
            cells = [escape(_marked(cell, "", "*")) for cell in row.cells]
            style = "dim" if row.source == "reference" else None
            grid.add_row(escape(indent + row.label), *cells, style=style)
        console.print(grid)
        for line in self.lines_below():
            console.print(f"- {escape(line)}")


def _heading(column: Column, between: str = " ", *, arrow: bool = True) -> str:
    """A column's group and name with its unit and the direction of better."""
    group = f"{column.group}{between}" if column.group else ""
    unit = f" ({column.unit})" if column.unit else ""
    return f"{group}{column.name}{unit}{_ARROWS[column.better] if arrow else ''}"


def _marked(cell: Cell | None, before: str, behind: str) -> str:
    if cell is None:
        return ""
    return f"{before}{cell.text}{behind}" if cell.best else cell.text


def _plain(text: str) -> str:
    """Text that Markdown shows as it is, also in a cell."""
    return re.sub(r"([\\|*<`\[])", r"\\\1", text.replace("\n", " "))
