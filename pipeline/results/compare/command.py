"""`motionloom compare`: several runs on one page, without loading any of their models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.results.compare.page import comparison_page, missing_lines
from motionloom.pipeline.results.compare.runs import (
    ComparedRun,
    StageDifferences,
    open_runs,
    setting_differences,
)
from motionloom.pipeline.results.compare.tables import ComparedTable, compared_tables
from motionloom.pipeline.store.files import require_file_place

HEADLINES = (
    ("reconstruction.mpjpe", "MPJPE, mm"),
    ("tma.t2m_r1", "text to motion R@1"),
    ("tma.fid", "FID"),
    ("agreement.everything", "does all its caption says"),
    ("beat_align.bailando", "Beat Align"),
    ("movement.fid_k", "FID_k"),
)
"""Figures that the terminal shows, and their titles there."""
KEYS = 6
"""Settings that are named before the rest is counted."""


def compare_runs(
    runs: Sequence[Path], out: Path = Path("compare.html"), *, console: Console | None = None
) -> Path:
    """Settings, curves and figures of several runs, finished or not, on one page; returns its path.

    Args:
        runs: Two run folders or more, at most eight.
        out: The page.
        console: Where the short table goes; standard output by default.
    """
    console = console or make_console()
    require_file_place(out)
    opened = open_runs(runs)
    differences, tables = setting_differences(opened), compared_tables(opened)
    comparison_page(opened, differences, tables).write(out)
    print_comparison(console, opened, differences, tables)
    console.print(str(out.resolve()), soft_wrap=True)
    return out


def print_comparison(
    console: Console,
    runs: Sequence[ComparedRun],
    differences: Sequence[StageDifferences],
    tables: Sequence[ComparedTable],
) -> None:
    """One row a run with the leading figures, then what is missing and what was measured otherwise."""
    leading = []
    for name, title in HEADLINES:
        found = next((t for t in tables if any(column.name == name for column in t.columns)), None)
        if found is not None:
            leading.append((name, title, found))
    console.print(_table(runs, leading))
    for run in runs:
        if lines := missing_lines(run):
            console.print(f"{run.label}: missing {'; '.join(lines)}", markup=False, soft_wrap=True)
    for sentence in dict.fromkeys(table.difference for _, _, table in leading if table.difference):
        console.print(sentence, markup=False, soft_wrap=True)
    keys = [f"{one.stage}.{key}" if one.stage else key for one in differences for key in one.differences]
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
            figure = None if row is None else row.figures.get(name)
            if row is None or figure is None:
                cells.append("–")
            else:
                mark = {True: " *", False: " (*)", None: ""}[row.best.get(name)]
                cells.append(f"{figure.text()}{mark}")
        table.add_row(*cells)
    if any(row.best.get(name) is False for name, _, found in leading for row in found.rows):
        table.caption, table.caption_justify = "(*) its interval overlaps another's", "left"
    return table
