"""`motionloom evaluate`: figures of a run, alone or beside a paper's."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.cli.options import At, Device
from motionloom.pipeline.launch.console import make_console


def evaluate(
    run_folders: Annotated[
        list[Path] | None,
        typer.Argument(help="A run folder (runs/NAME). With --table several, or none.", show_default=False),
    ] = None,
    clips: Annotated[int | None, typer.Option(help="At most this many test clips.")] = None,
    repeats: Annotated[
        int | None, typer.Option(help="Repetitions of everything that draws at random.")
    ] = None,
    at: At = None,
    device: Device = "auto",
    table: Annotated[
        str | None,
        typer.Option(
            help="Measure nothing; show a table of a paper (ude/2), or all of it (ude), with finished runs' "
            "rows; `list` names the tables."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Markdown file for a table.")] = None,
) -> None:
    """Figures on the test split, each beside its trivial answer, and a page; with --table, beside a paper's.

    Example: `motionloom evaluate runs/humantomato-tiny --repeats 5`

    With --at figures go to RUN/at/, and one process measures.

    Example: `motionloom evaluate --table humantomato/7 runs/baselines-tiny runs/humantomato-tiny -o seven.md`
    """
    runs = run_folders or []
    if table is not None:
        _show_table(table, runs, out, measuring=clips or repeats or at or device != "auto")
        return
    if out is not None:
        raise UserError("--out is of a table; name one, like --table humantomato/7")
    if len(runs) != 1:
        raise UserError(
            f"{len(runs)} run folders to evaluate; name one, like: motionloom evaluate runs/NAME "
            f"(several only with --table)"
        )
    from motionloom.pipeline.runs.api import evaluate_run

    evaluate_run(
        runs[0], at=at, clips=clips, repeats=repeats, device=device, share=True, console=make_console()
    )


def _show_table(table: str, runs: list[Path], out: Path | None, *, measuring: object) -> None:
    """Show a table of a paper, or list all; refuse what is not of tables."""
    from motionloom.pipeline.results.paper.compare import compare_with_paper, list_tables

    if measuring:
        raise UserError(
            "--clips, --repeats and --device measure anew (--at too), and a table shows what was measured; "
            "leave them out"
        )
    if table != "list":
        compare_with_paper(table, runs, out=out, console=make_console())
    elif runs or out is not None:
        raise UserError("--table list names the tables alone; to see one, give --table NAME RUN...")
    else:
        list_tables(make_console())
