"""Runs beside the numbers of the papers: what `motionloom evaluate --table` does."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table

from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.files import write_text
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.results.paper.fill import fill
from motionloom.pipeline.results.paper.filled import FilledTable
from motionloom.pipeline.results.paper.schema import PaperTable
from motionloom.pipeline.store.files import require_file_place
from motionloom.pipeline.store.yaml import read_yaml


def compare_with_paper(
    table: str, runs: Sequence[Path] = (), *, out: Path | None = None, console: Console | None = None
) -> list[FilledTable]:
    """Print tables of a paper with the rows of finished runs, or write them to the file `out` as Markdown.

    Nothing is measured and no model is loaded: the figures are those of the runs' finished evaluations.

    Args:
        table: Its name, such as `humantomato/7`, or a paper's, such as `ude`, for all of its tables.
        runs: Run folders; without any, the paper's numbers stand alone.
        out: File (.md) to write in place of printing.
        console: Where to print; standard output by default.
    """
    console = console or make_console()
    if out is not None:
        require_file_place(out, ".md")
    names = [name for name in shipped_tables() if name.startswith(f"{table}/")] or [table]
    tables = [fill(name, paper_table(name), runs) for name in names]
    page = "\n".join(filled.markdown() for filled in tables)
    if out is not None:
        write_text(out, page)
        console.print(str(out), soft_wrap=True)
    elif console.is_terminal:
        console.print(Markdown(page))
    else:
        console.print(page, markup=False, highlight=False, soft_wrap=True)
    return tables


def list_tables(console: Console | None = None) -> None:
    """Print the names of all tables, with what each compares and how many of its rows have a model."""
    grid = Table("table", "what it compares", "section", "rows", "of which we can have", title_justify="left")
    grid.title = "tables of the papers (motionloom evaluate --table NAME RUN...)"
    for name in shipped_tables():
        table = paper_table(name)
        ours = sum(row.ours is not None or row.recorded for row in table.rows)
        grid.add_row(name, table.title, table.section, str(len(table.rows)), str(ours))
    (console or make_console()).print(grid)


def shipped_tables() -> dict[str, Path]:
    """The tables that come with the package: `PAPER/NUMBER` -> its file, in the papers' order."""
    folder = Path(str(resources.files("motionloom.configs"))) / "tables"
    files = [(path.relative_to(folder).parts[0], int(path.stem), path) for path in folder.rglob("*.yaml")]
    return {f"{paper}/{number}": path for paper, number, path in sorted(files)}


def paper_table(name: str) -> PaperTable:
    """A table by its name, such as `humantomato/7`."""
    shipped = shipped_tables()
    if name not in shipped:
        raise UserError(f"--table {name}: no such table{nearest(name.lower(), list(shipped))}")
    path = shipped[name]
    return PaperTable.parse(read_yaml(path), str(path))
