"""The comparison in short, for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.compare.measures import HEADLINES
from motionloom.pipeline.compare.page import missing_lines
from motionloom.pipeline.compare.runs import ComparedRun
from motionloom.pipeline.compare.settings import StageDifferences
from motionloom.pipeline.compare.tables import ComparedTable

KEYS = 6
"""Settings that are named before the rest is counted."""


def print_comparison(
    console: Console,
    runs: Sequence[ComparedRun],
    differences: Sequence[StageDifferences],
    tables: Sequence[ComparedTable],
) -> None:
    """One row a run with the leading figures, then what is missing and what was measured otherwise."""
    leading = []
    for name, title in HEADLINES:
        found = next((t for t in tables if any(column.title == name for column in t.columns)), None)
        if found is not None:
            leading.append((name, title, found))
    console.print(_table(runs, leading))
    for run in runs:
        if lines := missing_lines(run):
            console.print(f"{run.label}: missing {'; '.join(lines)}", markup=False, soft_wrap=True)
    for sentence in dict.fromkeys(table.difference for _, _, table in leading if table.difference):
        console.print(sentence, markup=False, soft_wrap=True)
    keys = [f"{d.stage}.{one.key}" if d.stage else one.key for d in differences for one in d.differences]
    if keys:
        more = f" and {len(keys) - KEYS} more" if len(keys) > KEYS else ""
        console.print(f"settings that differ: {', '.join(keys[:KEYS])}{more}", markup=False, soft_wrap=True)


def _table(runs: Sequence[ComparedRun], leading: Sequence[tuple[str, str, ComparedTable]]) -> Table:
    titles = ["run", "finished", *(title for _, title, _ in leading)]
    table = Table(*titles, title=f"{len(runs)} runs (* best of those measured alike)", title_justify="left")
    for run in runs:
        done = sum(stage.usable for stage in run.state.stages)
        cells = [escape(run.label), f"{done} of {len(run.state.stages)}"]
        for name, _, found in leading:
            row = next((row for row in found.rows if row.run is run), None)
            column = next(column for column in found.columns if column.title == name)
            figure = None if row is None else row.figures.get(name)
            if row is None or figure is None:
                cells.append("–")
            else:
                mark = {True: " *", False: " (*)", None: ""}[row.best.get(name)]
                cells.append(f"{figure.text(column.form)}{mark}")
        table.add_row(*cells)
    if any(row.best.get(name) is False for name, _, found in leading for row in found.rows):
        table.caption, table.caption_justify = "(*) its interval overlaps another's", "left"
    return table
