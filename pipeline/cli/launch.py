"""`motionloom launch`: a recipe on a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.pipeline.cli.options import Sets
from motionloom.pipeline.launch.console import make_console


def launch(
    recipe: Annotated[str, typer.Argument(help="A shipped recipe's name (see info) or a .yaml file.")],
    engine: Annotated[str, typer.Option("--engine", "-e", help="slurm, kubernetes or skypilot.")],
    nodes: Annotated[int, typer.Option(help="Machines that train together.")] = 1,
    gpus_per_node: Annotated[int, typer.Option(help="GPUs of each; 0 trains on CPUs.")] = 8,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Run folder, as the cluster sees it; default runs/NAME."),
    ] = None,
    sets: Sets = None,
    cluster: Annotated[
        list[str] | None,
        typer.Option(
            "--cluster", help="Of the engine: KEY=VALUE (partition, image, claim, ...). May be repeated."
        ),
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--file", help="Where to write the YAML; default NAME-ENGINE.yaml.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan and what would be submitted; write nothing.")
    ] = False,
) -> None:
    """Run a recipe on a cluster: its stages in groups, each with the machines that it needs.

    On SLURM the jobs are submitted. For Kubernetes and SkyPilot it writes one YAML file and says how to
    start it.

    Example: `motionloom launch humantomato-paper --engine slurm --nodes 2 --cluster partition=gpu --dry-run`
    """
    from motionloom.pipeline.cluster.command import launch_recipe

    launch_recipe(
        recipe,
        engine,
        nodes=nodes,
        gpus_per_node=gpus_per_node,
        out=out,
        overrides=sets or (),
        options=cluster or (),
        file=file,
        dry_run=dry_run,
        console=make_console(),
    )
