"""A filled table: its page of Markdown, and the notes below it."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeVar

from motionloom.pipeline.results.paper.protocol import Difference
from motionloom.pipeline.results.paper.schema import Column, PaperTable

T = TypeVar("T")
Source = Literal["paper", "ours", "missing", "reference"]
"""The paper's row; a model of ours; no model of ours; a reference baseline."""
_WHO = {"paper": "paper", "ours": "ours", "missing": "ours", "reference": "no model"}
_PAPERS = {"humantomato": "HumanTOMATO", "ude": "UDE"}
_ARROWS = {"lower": " ↓", "higher": " ↑", None: ""}
_LONG = 40
"""A longer description of the paper's protocol is not repeated with every difference."""


class Cell(NamedTuple):
    """A number as it is printed, the paper's or ours."""

    text: str
    alike: str = ""
    """Key of the protocol of a figure of ours: figures with equal keys were measured alike."""
    best: bool = False


@dataclass(frozen=True)
class FilledRow:
    """A row of the paper, of a model of ours, or of a reference baseline."""

    source: Source
    method: str
    """The paper's row that it belongs to; empty for a baseline that belongs to all."""
    label: str
    """The paper's method, the stage of a run, or a reference baseline."""
    cells: tuple[Cell | None, ...]


@dataclass(frozen=True)
class FilledTable:
    """A paper's table with rows of runs."""

    name: str
    table: PaperTable
    rows: tuple[FilledRow, ...]
    differences: Mapping[str, Sequence[Difference]] = field(default_factory=dict)
    """By run and evaluation."""
    notes: tuple[str, ...] = ()

    def lines_below(self) -> Iterator[str]:
        """Notes, then what was measured otherwise, one line for each evaluation."""
        yield from self.notes
        if alone := [_heading(column) for column in self.table.columns if not column.printed]:
            yield f"{', '.join(alone)}: not in the paper, a figure of ours alone."
        protocol = self.table.measured.dump().values()
        for evaluation, differences in self.differences.items():
            parts = []
            for what, ours, paper in differences:
                theirs = "the paper does not say" if paper is None else f"paper: {paper}"
                if paper is not None and len(paper) > _LONG and paper in protocol:
                    theirs = "paper: see above"
                parts.append(f"{what} {ours} ({theirs})")
            yield f"{evaluation}: {'; '.join(parts)}"

    def markdown(self) -> str:
        """A pipe table, the best figures bold, and what is to be known as a list below."""
        paper, _, number = self.name.partition("/")
        section = re.sub(r"^(?!appendix)", "section ", self.table.section)
        caption = f"{_PAPERS.get(paper, paper)} Table {number}: {self.table.title} ({section})"
        names = [_plain(_heading(column) + _ARROWS[column.better]) for column in self.table.columns]
        rows = [["", "", *names], ["---", "---", *("---:" for _ in names)]]
        for row in self.rows:
            texts = [(cell.text, cell.best) if cell else ("", False) for cell in row.cells]
            cells = [f"**{text}**" if best else text for text, best in texts]
            rows.append([_plain(row.label), _WHO[row.source], *cells])
        body = [f"| {' | '.join(row)} |" for row in rows]
        below = [f"- {_plain(line)}" for line in self.lines_below()]
        return "\n".join([f"**{_plain(caption)}**", "", *body, "", *below, ""])


def _heading(column: Column) -> str:
    """A column's title with its unit."""
    return f"{column.title} ({column.unit})" if column.unit else column.title


def _plain(text: str) -> str:
    """Text that Markdown shows as it is, also in a cell."""
    return re.sub(r"([\\|*<`\[])", r"\\\1", text.replace("\n", " "))


def mark_best(rows: Sequence[FilledRow], columns: Sequence[Column]) -> tuple[FilledRow, ...]:
    """The rows with the best figures marked: of models of ours, two or more of them measured alike.

    The paper's rows, recorded motion and other reference baselines are never ranked. Equal figures
    are marked together; the figure as it is printed decides.
    """
    cells = [list(row.cells) for row in rows]
    for at, column in enumerate(columns):
        alike: dict[str, dict[int, float]] = defaultdict(dict)
        for number, row in enumerate(rows):
            if row.source == "ours" and (cell := row.cells[at]) and cell.alike:
                alike[cell.alike][number] = float(cell.text.split(" ")[0])
        for values in alike.values() if column.better else ():
            wanted = min(values.values()) if column.better == "lower" else max(values.values())
            best = [number for number, value in values.items() if value == wanted]
            for number in best if len(set(values.values())) > 1 else ():
                if cell := cells[number][at]:
                    cells[number][at] = cell._replace(best=True)
    return tuple(replace(row, cells=tuple(own)) for row, own in zip(rows, cells, strict=True))


def notes_of(
    table: PaperTable,
    rows: Sequence[FilledRow],
    settings: Sequence[str],
    remarks: Sequence[str],
    *,
    with_runs: bool,
) -> tuple[str, ...]:
    """Sentences, most important first."""
    measured = table.measured
    facts = {"data": measured.data, "split": measured.split, "judged by": measured.evaluator}
    facts |= {"repeats": measured.repeats, "± is": measured.spread}
    said = "; ".join(f"{what} {fact}" for what, fact in facts.items() if fact)
    out = [f"The paper's numbers: {said}. {measured.note}".strip()]
    out += [f"{row.method}: {row.note}." for row in table.rows if row.note]
    if not with_runs:  # what follows is about figures of ours
        return tuple(out)
    out.append("The paper's numbers are never ranked with ours: they were measured otherwise, as listed.")
    cells = [(row, cell) for row in rows for cell in row.cells if cell]
    if any(cell.best for _, cell in cells):
        out.append("Marked as best: among models of ours that were measured alike, whatever their intervals.")
    if any("±" in cell.text for row, cell in cells if row.source != "paper"):
        out.append(
            "± of ours is half of the 95 % interval: over clips, of figures of whole sets over repeats."
        )
    columns = table.columns
    for differs, sharing in _shared((column.differs, column) for column in columns):
        out.append(f"{_titles(sharing)}: {differs}.")
    for why, sharing in _shared((column.why, column) for column in columns):
        out.append(f"No figure of ours for {_titles(sharing)}: {why}.")
    for why, methods in _shared((row.why, row.method) for row in table.rows):
        out.append(f"No model of ours for {', '.join(methods)}: {why}.")
    missing = [row.method for row in rows if row.source == "missing"]
    absent = [row.method for row in table.rows if row.ours is not None and row.method in missing]
    if absent:
        out.append(f"Not in these runs: {', '.join(dict.fromkeys(absent))}.")
    out += [f"{text}." for text in remarks]
    out += [f"Another setting than the paper's: {text}." for text in settings]
    return tuple(out)


def _shared(things: Iterable[tuple[str, T]]) -> list[tuple[str, list[T]]]:
    """(text, the things that share it), in order; empty texts left out."""
    groups: dict[str, list[T]] = defaultdict(list)
    for text, thing in things:
        if text:
            groups[text].append(thing)
    return list(groups.items())


def _titles(columns: Iterable[Column]) -> str:
    """Names of columns, the group's once: "R-Precision (32) Top1, Top2"."""
    out = []
    group = ""
    for column in columns:
        out.append(column.name if column.group == group else column.title)
        group = column.group
    return ", ".join(out)
