"""What stands below a table: what is compared with what, what is missing and why."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from motionloom.pipeline.published.filled import FilledRow
from motionloom.pipeline.published.schema import Column, PaperTable

T = TypeVar("T")


def notes_of(
    table: PaperTable, rows: Sequence[FilledRow], settings: Sequence[str], *, with_runs: bool
) -> tuple[str, ...]:
    """Sentences, most important first."""
    measured, out = table.measured, []
    said = [f"data {measured.data}"]
    said += [f"split {measured.split}"] if measured.split else []
    said += [f"judged by {measured.evaluator}"] if measured.evaluator else []
    said += [f"repeats {measured.repeats}"] if measured.repeats else []
    said += [f"± is {measured.spread}"] if measured.spread else []
    out.append(f"The paper's numbers: {'; '.join(said)}." + (f" {measured.note}" if measured.note else ""))
    out += [f"{row.method}: {row.note}." for row in table.rows if row.note]
    if not with_runs:
        return tuple(out)
    out.append("The paper's numbers are never ranked with ours: they were measured otherwise, as listed.")
    if any(cell and cell.best for row in rows for cell in row.cells):
        out.append("Marked as best: among models of ours that were measured alike, whatever their intervals.")
    if any(cell and cell.spread for row in rows if row.source != "paper" for cell in row.cells):
        out.append("± of ours is half of the 95 % interval of the mean over repeats.")
    columns = table.columns
    for differs, found in _shared(columns, lambda column: column.differs):
        out.append(f"{_titles(found)}: {differs}.")
    for why, found in _shared(columns, lambda column: column.why):
        out.append(f"No figure of ours for {_titles(found)}: {why}.")
    for why, methods in _shared(table.rows, lambda row: row.why):
        out.append(f"No model of ours for {', '.join(row.method for row in methods)}: {why}.")
    missing = [row.method for row in rows if row.source == "missing"]
    absent = [row.method for row in table.rows if row.ours is not None and row.method in missing]
    if absent:
        out.append(f"Not in these runs: {', '.join(dict.fromkeys(absent))}.")
    out += [f"Another setting than the paper's: {text}." for text in settings]
    return tuple(out)


def _shared(things: Iterable[T], text: Callable[[T], str]) -> list[tuple[str, list[T]]]:
    """(text, the things that share it), in order; empty texts left out."""
    found: dict[str, list[T]] = defaultdict(list)
    for thing in things:
        if text(thing):
            found[text(thing)].append(thing)
    return list(found.items())


def _titles(columns: Iterable[Column]) -> str:
    """Names of columns, the group's once: "R-Precision (32) Top1, Top2"."""
    out, group = [], ""
    for column in columns:
        out.append(column.name if column.group == group else column.title)
        group = column.group
    return ", ".join(out)
