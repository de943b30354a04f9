"""Runs beside the numbers of the papers: what `motionloom evaluate --table` does."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from motionloom.datasets.base.files import write_text
from motionloom.datasets.schema import UserError
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.published.fill import fill
from motionloom.pipeline.published.filled import FilledTable
from motionloom.pipeline.published.shipped import paper_table, shipped_tables
from motionloom.pipeline.published.writers import SUFFIXES, WRITERS, print_text
from motionloom.pipeline.store.files import require_file_place


def compare_with_paper(
    table: str,
    runs: Sequence[Path] = (),
    *,
    format: str | None = None,
    out: Path | None = None,
    console: Console | None = None,
) -> FilledTable:
    """Print a table of a paper with the rows of finished runs, or write it to the file `out`.

    Nothing is measured and no model is loaded: the figures are those of the runs' finished evaluations.

    Args:
        table: Its name, such as `humantomato/7`, or a YAML file of the same form.
        runs: Run folders; without any, the paper's numbers stand alone.
        format: text, markdown, csv, latex or json; by default what the suffix of `out` says, else text.
        out: File to write in place of printing.
        console: Where to print; standard output by default.
    """
    console = console or make_console()
    form = _format(format, out)
    if out is not None:
        require_file_place(out)
    filled = fill(table, paper_table(table), runs)
    if out is not None:
        write_text(out, WRITERS[form](filled))
        console.print(str(out), soft_wrap=True)
    elif form == "text":
        print_text(filled, console)
    else:
        console.print(WRITERS[form](filled), soft_wrap=True, markup=False, emoji=False, end="")
    return filled


def list_tables(console: Console | None = None) -> None:
    """Print the names of all tables, with what each compares and how many of its rows have a model."""
    grid = Table("table", "what it compares", "section", "rows", "of which we can have", title_justify="left")
    grid.title = "tables of the papers (motionloom evaluate --table NAME RUN...)"
    for name in shipped_tables():
        table = paper_table(name)
        ours = sum(row.ours is not None or row.recorded for row in table.rows)
        grid.add_row(name, table.title, table.section, str(len(table.rows)), str(ours))
    (console or make_console()).print(grid)


def _format(given: str | None, out: Path | None) -> str:
    if given is None:
        return SUFFIXES.get(out.suffix.lower(), "text") if out is not None else "text"
    if given not in WRITERS:
        near = difflib.get_close_matches(given, WRITERS, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"choose {', '.join(WRITERS)}"
        raise UserError(f"--format {given}: no such format; {hint}")
    return given
