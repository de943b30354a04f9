"""`motionloom sweep`: one recipe with every combination of some settings, a run folder for each.

    motionloom sweep RECIPE --over tokenizer.optim.lr=1e-3,2e-3 --over seed=1,2,3 -o sweeps/lr

Runs follow each other, the last `--over` changing fastest. Each is an ordinary run: it goes on after a kill,
and what is finished is skipped. Stages that do not depend on what is swept are made once and taken over by
the runs that follow (`take_over.py`).
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.pipeline.compare.measures import HEADLINES
from motionloom.pipeline.compare.runs import MOST, ComparedRun
from motionloom.pipeline.compare.tables import compared_tables
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.launch.process import srun_tasks
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.graph import make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.runs.replace import replaced_stages, require_asked
from motionloom.pipeline.runs.take_over import take_over, to_take_over
from motionloom.pipeline.store.run_state import run_state


@dataclass(frozen=True)
class Axis:
    """One setting, and the values it takes."""

    key: str
    values: tuple[str, ...]

    @staticmethod
    def parse(text: str) -> Axis:
        """`tokenizer.optim.lr=1e-3,2e-3`; commas within brackets or quotes do not divide."""
        key, equals, listed = text.partition("=")
        values = tuple(value.strip() for value in _divided(listed))
        if not equals or not key.strip() or not all(values):
            raise UserError(f"--over {text}: write it as stage.field=value,value or seed=1,2,3")
        if len(set(values)) < len(values):
            raise UserError(f"--over {text}: names a value twice")
        return Axis(key.strip(), values)


@dataclass(frozen=True)
class Combination:
    """One run of a sweep."""

    folder: Path
    values: tuple[str, ...]
    """In the order of the axes."""
    recipe: Recipe
    sets: tuple[str, ...]


def run_sweep(
    recipe: str | Path,
    over: Sequence[str],
    out: Path | None = None,
    *,
    overrides: Sequence[str] = (),
    index: int | None = None,
    dry_run: bool = False,
    replace: bool = False,
    console: Console | None = None,
) -> list[Path]:
    """Run a recipe with every combination of the settings in `over`; returns the run folders.

    Args:
        recipe: As for `run_recipe`.
        over: `stage.field=value,value`, one for each setting.
        out: Folder of the run folders; sweeps/NAME of the recipe without it.
        overrides: Settings of all runs.
        index: Run this combination alone, counted from 0: for the jobs of a cluster.
        dry_run: Print what each run would do.
        replace: As for `run_recipe`, in each of them.
        console: Where all is printed; standard output by default.
    """
    console = console or make_console()
    axes = [Axis.parse(text) for text in over]
    runs = _combinations(recipe, axes, out, overrides)
    if index is not None and not 0 <= index < len(runs):
        raise UserError(f"--index {index}: there are {len(runs)} combinations; take 0 to {len(runs) - 1}")
    if dry_run:
        console.print(_plan_table(axes, runs, index))
        return [run.folder for run in runs]
    folders, launched = [run.folder for run in runs], "RANK" in os.environ or srun_tasks() > 1
    if launched and index is None:
        raise UserError("a launcher has started several processes: give them one combination, --index K")
    if not replace:  # before anything runs
        for number, run in enumerate(runs):
            if index in (None, number):
                plan = make_plan(run.recipe, run.folder)
                require_asked(run.folder, run.recipe.name, replaced_stages(run.folder, plan))
    for number, run in enumerate(runs):
        if index not in (None, number):
            continue
        console.print(f"[bold]sweep {number + 1}/{len(runs)}[/] {escape(run.folder.name)}")
        if not launched:  # several processes would not all see the same plan
            others = [folder for folder in folders if folder != run.folder]
            taken = take_over(make_plan(run.recipe, run.folder), run.folder, others)
            for source in dict.fromkeys(taken.values()):
                names = ", ".join(name for name, place in taken.items() if place == source)
                console.print(f"    made already in {escape(source.name)}: {names}", soft_wrap=True)
        if launched or run.recipe.hardware.world() == 1:
            run_recipe(recipe, run.folder, overrides=run.sets, replace=replace, console=console)
        else:
            _run_alone(recipe, run, replace)
    if index is None:
        _say_outcome(axes, runs, console)
    return folders


def _run_alone(recipe: str | Path, run: Combination, replace: bool) -> None:
    """A run of several processes by a command of its own: they form one team, and a team is formed once."""
    words = [word for text in run.sets for word in ("--set", text)]
    more = ["--replace"] if replace else []
    command = [sys.executable, "-P", "-m", "motionloom.pipeline.cli.main", "run", str(recipe)]
    code = subprocess.run([*command, "--out", str(run.folder), *words, *more], check=False).returncode
    if code:
        raise UserError(f"{run.folder}: stopped with exit code {code}; the same command goes on from here")


def _combinations(
    recipe: str | Path, axes: Sequence[Axis], out: Path | None, overrides: Sequence[str]
) -> list[Combination]:
    """All runs, their recipes checked before anything runs."""
    if not axes:
        raise UserError("name what is swept over, like: --over seed=1,2,3")
    keys = [axis.key for axis in axes]
    if len(set(keys)) < len(keys):
        raise UserError("--over names a setting twice; list all its values in one")
    folder, shorts = out, _short(keys)
    runs: dict[str, Combination] = {}
    for values in product(*(axis.values for axis in axes)):
        sets = (*overrides, *(f"{key}={value}" for key, value in zip(keys, values, strict=True)))
        loaded = load_recipe(recipe, sets)
        folder = folder or Path("sweeps") / loaded.name
        name = "_".join(f"{short}={_plain(value)}" for short, value in zip(shorts, values, strict=True))
        if name in runs:
            raise UserError(f"two combinations would be called {name}; write their values otherwise")
        runs[name] = Combination(folder / name, values, loaded, sets)
    return list(runs.values())


def _short(keys: Sequence[str]) -> list[str]:
    """As many of the last names of each key as tell them all apart."""
    parts = [key.split(".") for key in keys]
    for depth in range(1, max(map(len, parts)) + 1):
        names = [".".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return list(keys)


def _plain(value: str) -> str:
    """A value as it may stand in the name of a folder."""
    sign = "-" if value.startswith("-") else ""
    return sign + (re.sub(r"[^A-Za-z0-9.+-]+", "-", value).strip("-") or "empty")


def _divided(text: str) -> list[str]:
    """At the commas outside brackets and quotes."""
    out, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        depth += 0 if quote else (letter in "[{") - (letter in "]}")
        if letter == "," and not depth and not quote:
            out.append("")
        else:
            out[-1] += letter
    return out


def _plan_table(axes: Sequence[Axis], runs: Sequence[Combination], index: int | None) -> Table:
    """What each run would do, and which stages it would take over from those before it."""
    titles = ["index", "run", *_short([axis.key for axis in axes]), "to run", "shared"]
    table = Table(*titles, title=f"{len(runs)} runs in {runs[0].folder.parent}", title_justify="left")
    first: dict[str, str] = {}
    for number, run in enumerate(runs):
        plan = make_plan(run.recipe, run.folder)
        todo = [row for row in plan if row.action in {"run", "resume"}]
        found = to_take_over(plan, run.folder, [other.folder for other in runs if other is not run])
        shared = [row for row in todo if row.stage.name in found or row.fingerprint in first]
        for row in plan:
            first.setdefault(row.fingerprint, run.folder.name)
        note = "" if index in (None, number) else " (another index)"
        count = f"{len(todo) - len(shared)} of {len(plan)}{note}"
        names = ", ".join(row.stage.name for row in shared)
        table.add_row(str(number), escape(run.folder.name), *map(escape, run.values), count, names)
    return table


def _say_outcome(axes: Sequence[Axis], runs: Sequence[Combination], console: Console) -> None:
    """The leading figures of each run, and how to see them on one page."""
    states = [run_state(run.folder) for run in runs]
    opened = [
        ComparedRun(run.folder.name, number % MOST, state)
        for number, (run, state) in enumerate(zip(runs, states, strict=True))
    ]
    tables = compared_tables(opened)
    columns = []
    for name, title in HEADLINES:
        found = next((t for t in tables if any(column.title == name for column in t.columns)), None)
        if found is not None:
            columns.append((title, next(c for c in found.columns if c.title == name), found))
    titles = [*_short([axis.key for axis in axes]), "finished", *(title for title, _, _ in columns)]
    what = " (* best of those measured alike)" if columns else ""
    table = Table(*titles, title=f"{len(runs)} runs{what}", title_justify="left")
    for run, shown in zip(runs, opened, strict=True):
        done = sum(stage.usable for stage in shown.state.stages)
        cells = [*map(escape, run.values), f"{done} of {len(shown.state.stages)}"]
        for _, column, found in columns:
            row = next((row for row in found.rows if row.run is shown), None)
            figure = None if row is None else row.figures.get(column.title)
            best = row is not None and row.best.get(column.title) is not None
            cells.append("–" if figure is None else f"{figure.text(column.form)}{' *' if best else ''}")
        table.add_row(*cells)
    console.print(table)
    some = " ".join(str(run.folder) for run in runs[:MOST])
    if len(runs) > 1:
        more = f" (at most {MOST} at once)" if len(runs) > MOST else ""
        console.print(f"on one page{more}: motionloom compare {some}", soft_wrap=True, markup=False)
