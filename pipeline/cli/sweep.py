"""`motionloom sweep`: one recipe with several settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.pipeline.launch.console import make_console


def sweep(
    recipe: Annotated[str, typer.Argument(help="A shipped recipe's name (see info) or a .yaml file.")],
    over: Annotated[
        list[str], typer.Option("--over", help="A setting and its values: stage.field=a,b. May be repeated.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of the run folders; default sweeps/NAME.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", "-s", help="Override one value in all runs. May be repeated.")
    ] = None,
    index: Annotated[
        int | None, typer.Option(help="Run this combination alone, from 0: for a cluster's job arrays.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what each run would do.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="As of run, for each of them.")] = False,
) -> None:
    """Run a recipe with every combination of some settings, and show the figures side by side.

    One run folder each. Stages that do not depend on what is swept are made once. Kill it at any moment and
    start it again: it goes on where it was.

    Example: `motionloom sweep humantomato-tiny --over tokenizer.optim.lr=1e-3,2e-3 --over seed=1,2 --dry-run`

    Example: `motionloom sweep humantomato-tiny --over seed=1,2,3 --set data_seed=7 -o sweeps/seeds`
    """
    from motionloom.pipeline.runs.sweep import run_sweep

    run_sweep(
        recipe,
        over,
        out,
        overrides=sets or (),
        index=index,
        dry_run=dry_run,
        replace=replace,
        console=make_console(),
    )
