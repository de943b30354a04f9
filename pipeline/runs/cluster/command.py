"""`motionloom launch`: a recipe on a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from motionloom.datasets.base.register import register
from motionloom.pipeline.cli.options import GoOn, Sets
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.launch.console import make_console


def launch(
    recipe: Annotated[str, typer.Argument(help="A shipped recipe's name (see info) or a .yaml file.")],
    on: Annotated[
        Literal["slurm", "kubernetes", "sky"], typer.Option(help="Engine of the cluster.")
    ] = "slurm",
    nodes: Annotated[int, typer.Option(help="Machines that train together.")] = 1,
    gpus_per_node: Annotated[int, typer.Option(help="GPUs of each; 0 trains on CPUs.")] = 8,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Run folder, as the cluster sees it; default runs/NAME."),
    ] = None,
    sets: Sets = None,
    go_on: GoOn = None,
    cluster: Annotated[
        list[str] | None,
        typer.Option(
            "--cluster", help="What to ask for: KEY=VALUE (partition, image, parts, ...). May be repeated."
        ),
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option("--sweep", help="SLURM: a run for each value: KEY=VALUE,VALUE. May be repeated."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan and what would be submitted; write nothing.")
    ] = False,
) -> None:
    """Run a recipe on a cluster: a job per branch of its stages, each with the machines that it can use.

    A conversion may be an array (parts). Jobs that a signal has ended go on by themselves.

    Example: `motionloom launch humantomato-paper --nodes 2 --cluster partition=gpu --dry-run`

    Example: `motionloom launch ude-paper --on sky --cluster image=I --cluster volume=V --dry-run`

    Example: `motionloom launch humantomato-tiny --sweep tma.optim.lr=1e-4,2e-4 --dry-run`

    Example: `motionloom launch bvh-body --set data.source=mocap --cluster parts=8 --dry-run`
    """
    from motionloom.pipeline.runs.cluster.launch import launch_recipe

    launch_recipe(
        recipe,
        on=on,
        nodes=nodes,
        gpus_per_node=gpus_per_node,
        out=out,
        overrides=sets or (),
        go_on=go_on or (),
        options=cluster or (),
        sweep=sweep or (),
        dry_run=dry_run,
        console=make_console(),
    )


register(Command("launch", launch))
