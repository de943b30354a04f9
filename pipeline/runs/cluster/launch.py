"""`motionloom launch`: a recipe on a cluster, whose engine schedules, queues and tries again."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Literal

from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.console import say
from motionloom.pipeline.runs.cluster.kubernetes import manifest
from motionloom.pipeline.runs.cluster.launch_plan import LaunchPlan, make_launch_plan
from motionloom.pipeline.runs.cluster.sky import pipeline
from motionloom.pipeline.runs.cluster.slurm import launch_on_slurm
from motionloom.pipeline.runs.recipe import load_recipe

Engine = Literal["slurm", "kubernetes", "sky"]


def launch_recipe(
    recipe: str | Path,
    *,
    on: Engine = "slurm",
    nodes: int = 1,
    gpus_per_node: int = 8,
    out: Path | None = None,
    overrides: Sequence[str] = (),
    go_on: Sequence[str] = (),
    options: Sequence[str] = (),
    sweep: Sequence[str] = (),
    dry_run: bool = False,
    console: Console,
) -> None:
    """Submit a recipe; with `dry_run` what would be submitted is printed and nothing is written.

    `options` are `KEY=VALUE` words of `ClusterOptions`; `sweep` are `KEY=VALUE,VALUE` words, of which a run
    is made for each combination, in a folder of its name in `out`.
    """
    rows = list(product(*map(_values, sweep)))
    recipes = [load_recipe(recipe, [*overrides, *row]) for row in rows]
    asked = recipes[0].hardware.cluster.with_words(options)
    run = out or Path("runs", recipes[0].name)
    run = Path(os.path.abspath(run)) if on == "slurm" else Path(asked.mount, run)  # noqa: PTH100 - keeps links
    plans: list[LaunchPlan] = []
    for one, row in zip(recipes, rows, strict=True):
        folder = run / ",".join(row).replace("/", "-")
        plans.append(
            make_launch_plan(one, asked, out=folder, nodes=nodes, gpus_per_node=gpus_per_node, go_on=go_on)
        )
    if sweep and (on != "slurm" or asked.parts > 1 or any(plan.groups != plans[0].groups for plan in plans)):
        raise UserError(
            "--sweep is for SLURM, without parts, of rows that need equal machines; launch others apart"
        )
    for line in plans[0].lines(asked):
        # The rest of what a dry run prints is then a file that the engine takes.
        say(console, "# " * (on != "slurm") + line + f", {len(rows)} times" * bool(sweep))
    if on == "slurm":
        launch_on_slurm(plans, run, asked, dry_run=dry_run, console=console)
        return
    text = (manifest if on == "kubernetes" else pipeline)(plans[0], asked)
    command = ("kubectl apply --filename" if on == "kubernetes" else "sky jobs launch --yes").split()
    if dry_run:
        console.print(f"\n{text}", soft_wrap=True, markup=False, highlight=False)
        return
    if shutil.which(command[0]) is None:
        raise UserError(f"no {command[0]} here: install it, or look with --dry-run")
    with NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        if code := subprocess.run([*command, file.name]).returncode:
            raise UserError(f"{' '.join(command)} ended with exit code {code}; its lines stand above")


def _values(word: str) -> list[str]:
    """`a.b=1,2` as the settings `a.b=1` and `a.b=2`; commas within brackets are no borders."""
    key, equals, values = word.partition("=")
    if not equals or not values:
        raise UserError(f"--sweep '{word}': write KEY=VALUE,VALUE, for example tokenizer.optim.lr=1e-4,2e-4")
    return [f"{key}={value}" for value in re.split(r",(?![^\[{]*[\]}])", values)]
