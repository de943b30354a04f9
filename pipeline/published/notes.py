"""What stands below a table: what is compared with what, what is missing and why."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

from motionloom.pipeline.published.filled import FilledRow
from motionloom.pipeline.published.schema import PaperTable


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
    out += [f"{row.method}: {row.note}" for row in table.rows if row.note]
    if not with_runs:
        return tuple(out)
    out.append("The paper's numbers are never ranked with ours: they were measured otherwise, as listed.")
    if any(cell and cell.best for row in rows for cell in row.cells):
        out.append("Marked as best: among models of ours that were measured alike, and only there.")
    if any(cell and cell.spread for row in rows if row.source != "paper" for cell in row.cells):
        out.append("± of ours is half of the 95 % interval of the mean over repeats.")
    out += [f"{title}: {differs}" for differs, title in _shared((c.title, c.differs) for c in table.columns)]
    out += [
        f"No figure of ours for {titles}: {why}"
        for why, titles in _shared((c.title, c.why) for c in table.columns)
    ]
    out += [
        f"No model of ours for {names}: {why}"
        for why, names in _shared((r.method, r.why) for r in table.rows)
    ]
    missing = [row.method for row in rows if row.source == "missing"]
    absent = [row.method for row in table.rows if row.ours is not None and row.method in missing]
    if absent:
        out.append(f"Not in these runs: {', '.join(dict.fromkeys(absent))}")
    out += [f"Another setting than the paper's: {text}" for text in settings]
    return tuple(out)


def _shared(pairs: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """(text, names that share it) of pairs (name, text); empty texts left out."""
    names: dict[str, list[str]] = defaultdict(list)
    for name, text in pairs:
        if text:
            names[text].append(name)
    return [(text, ", ".join(found)) for text, found in names.items()]
