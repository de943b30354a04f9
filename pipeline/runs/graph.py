"""The stage graph: what will run and why, then running it.

A stage's fingerprint covers its kind and version, its full resolved config, the seed, facts about outside
files and the fingerprints of its inputs. A stage is finished when its folder holds an `artifact.json` with
that fingerprint and every output it lists. Anything else runs, and whatever stands below it has another
fingerprint and runs too.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.lock import file_lock
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.contract.stage import Every, Finished, Shelf, Stage, StageContext
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import process_rank
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.runs.beginning import prepare_folder
from motionloom.pipeline.runs.extend import extendable, extension
from motionloom.pipeline.runs.outside import require_elsewhere
from motionloom.pipeline.runs.perform import perform
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.store.artifact import Artifact, InputStage
from motionloom.pipeline.store.files import fingerprint_of, write_json
from motionloom.pipeline.store.outside import identity_of, place_from
from motionloom.pipeline.store.run_folder import stage_folder

Action = Literal["skip", "run", "resume", "leave"]


@dataclass(frozen=True)
class Selection:
    """Which part of the graph to run."""

    first: str | None = None
    """Run this stage and all below it again."""
    until: str | None = None
    """Stop after this stage: only it and what it needs. Several with commas between them."""
    only: str | None = None
    """Just this stage; its inputs must be finished."""
    force: bool = False
    """Run the selected stages even if they are finished."""


@dataclass(frozen=True)
class PlannedStage:
    """One row of the plan."""

    stage: Stage
    fingerprint: str
    action: Action
    reason: str
    asked: bool = False
    """The selection names it to run again (`--from`, `--force`)."""
    extendable: dict[str, Any] | None = None
    """What a longer training would be compared with."""
    identities: Mapping[str, str] = field(default_factory=dict)
    """What its inputs from outside were when the plan was made."""
    start: Path | None = None
    """A checkpoint that a stage which begins anew begins with."""


def make_plan(recipe: Recipe, run: Path, select: Selection | None = None) -> list[PlannedStage]:
    """Decide for every stage, in order, what happens to it."""
    select = select or Selection()
    wanted = selected(recipe, select)
    forced = _descendants(recipe, select.first) if select.first else set()
    if select.force:
        forced |= wanted
    plan: list[PlannedStage] = []
    rows: dict[str, PlannedStage] = {}
    for stage in recipe.stages:
        require_elsewhere(run, stage, recipe.outside)
        facts = _facts(recipe, stage, rows)
        fingerprint, others = fingerprint_of(facts), extendable(stage, facts)
        action, reason = _decide(recipe, stage, fingerprint, run, rows, forced, select)
        if action == "run" and stage.name not in forced:
            longer = extension(stage, others, stage_folder(run, stage.name))
            if longer is not None:
                action, reason = ("resume" if longer[0] else "run"), longer[1]
        if stage.name not in wanted and action != "skip":
            action, reason = "leave", "not selected"
        identities = {n: _fingerprint(recipe, n, rows) for n in stage.inputs.values() if n in recipe.outside}
        rows[stage.name] = PlannedStage(
            stage, fingerprint, action, reason, stage.name in forced, others, identities
        )
        plan.append(rows[stage.name])
    if select.only:
        for role, name in recipe.stage(select.only).inputs.items():
            if name in rows and rows[name].action != "skip":
                raise UserError(
                    f"--only {select.only}: its input '{role}' ({name}) is not finished; run it first"
                )
    return plan


def selected(recipe: Recipe, select: Selection) -> set[str]:
    """Names of the stages that may run; refuses selections that contradict each other."""
    first, until, only = select.first, select.until, select.only
    last = [name.strip() for name in until.split(",")] if until is not None else []
    named = [("--from", first), *(("--until", name) for name in last), ("--only", only)]
    for option, name in named:
        if name is not None:
            recipe.stage(name, option)
    for option, name in (("--from", first), ("--until", until)):
        if only and name and name != only:
            raise UserError(f"--only {only} runs that stage alone: leave {option} {name} out")
    needed = _ancestors(recipe, *last)
    if first and until and first not in needed:
        raise UserError(
            f"--from {first} --until {until}: '{until}' does not need '{first}', so there is nothing between "
            f"them; leave one out"
        )
    if first and select.force and not only:
        raise UserError(
            f"--from {first} runs that stage and those below it again, --force all that are selected: leave "
            f"one out"
        )
    if only:
        return {only}
    return needed if until is not None else {stage.name for stage in recipe.stages}


def _facts(recipe: Recipe, stage: Stage, rows: dict[str, PlannedStage]) -> dict[str, Any]:
    """What a stage's fingerprint is the digest of."""
    facts = {
        "kind": stage.kind.name,
        "version": stage.kind.version,
        "seed": recipe.seed_of(stage),
        "config": json.loads(json.dumps(fingerprint_fields(stage.config), default=str)),
        "external": stage.kind.external(stage.config),
        "inputs": {role: _fingerprint(recipe, name, rows) for role, name in stage.inputs.items()},
    }
    if any(isinstance(role, Every) for role in stage.kind.roles()):
        facts["order"] = list(stage.inputs)  # the first of several generators is the default
    return facts


def _fingerprint(recipe: Recipe, name: str, rows: Mapping[str, PlannedStage]) -> str:
    """Of an input: the fingerprint of a stage of the recipe, the identity of one outside."""
    if name in rows:
        return rows[name].fingerprint
    return str(identity_of(recipe.outside[name].folder))


def _decide(
    recipe: Recipe,
    stage: Stage,
    fingerprint: str,
    run: Path,
    rows: dict[str, PlannedStage],
    forced: set[str],
    select: Selection,
) -> tuple[Action, str]:
    folder = stage_folder(run, stage.name)
    artifact = Artifact.find(folder)
    if stage.name in forced:
        return "run", "forced" if select.force else f"from {select.first}"
    if artifact is None:
        started = folder / "started.json"
        if _started(folder) == fingerprint:
            return "resume", "started earlier, not finished"
        return "run", "never run" if not started.is_file() else "settings changed before it finished"
    if artifact.fingerprint != fingerprint:
        if _started(folder) == fingerprint:
            return "resume", "started earlier, not finished"
        return "run", _difference(recipe, artifact, stage, rows)
    gone = artifact.missing(folder)
    if gone:
        return "run", f"output {gone} is gone or has another size"
    above = [name for name in stage.inputs.values() if name in forced and rows[name].action == "run"]
    if above:
        return "run", f"below {above[0]}"
    return "skip", "finished"


def _started(folder: Path) -> str | None:
    """Fingerprint of what was begun last in a stage's folder."""
    started = folder / "started.json"
    return str(json.loads(started.read_text())["fingerprint"]) if started.is_file() else None


def _difference(recipe: Recipe, artifact: Artifact, stage: Stage, rows: Mapping[str, PlannedStage]) -> str:
    if artifact.kind != stage.kind.name or artifact.version != stage.kind.version:
        return f"{artifact.kind} v{artifact.version} is now {stage.kind.name} v{stage.kind.version}"
    changes = list(_changed_fields(artifact.config, stage.config.dump()))
    if changes:
        more = f" (+{len(changes) - 1} more)" if len(changes) > 1 else ""
        return f"changed: {changes[0]}{more}"
    for role, name in stage.inputs.items():
        old = artifact.inputs.get(role)
        if old is None or old.fingerprint != _fingerprint(recipe, name, rows):
            return f"input {name} changed"
    return "seed, source files or the order of inputs changed"


def _changed_fields(old: Any, new: Any, prefix: str = "") -> Iterator[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _changed_fields(old.get(key), new.get(key), f"{prefix}.{key}" if prefix else key)
    elif old != new:
        yield f"{prefix} {old} -> {new}"


def _ancestors(recipe: Recipe, *names: str) -> set[str]:
    """These stages and all that they need."""
    out: set[str] = set()
    todo = list(names)
    while todo:
        current = todo.pop()
        out.add(current)
        todo += [stage.name for stage in recipe.above(recipe.stage(current))]
    return out


def _descendants(recipe: Recipe, name: str) -> set[str]:
    out = {name}
    for stage in recipe.stages:
        if out & set(stage.inputs.values()):
            out.add(stage.name)
    return out


def plan_table(recipe: Recipe, plan: Sequence[PlannedStage]) -> Table:
    """The plan as a table for people."""
    table = Table(title=escape(f"{recipe.name}: {len(plan)} stages"), title_justify="left")
    for column in ("stage", "kind", "action", "why", "from"):
        table.add_column(column, overflow="fold")
    colours = {"run": "yellow", "resume": "cyan", "skip": "green", "leave": "dim"}
    for row in plan:
        colour = colours[row.action]
        inputs = ", ".join(dict.fromkeys(row.stage.inputs.values()))
        cells = (row.stage.name, row.stage.kind.name, f"[{colour}]{row.action}[/]")
        table.add_row(*cells, escape(row.reason), escape(inputs))
    return table


def require_fit(rows: Sequence[PlannedStage], hardware: Hardware) -> None:
    """Refuse, before anything runs, stages whose settings cannot run on this hardware."""
    for row in rows:
        try:
            row.stage.config.require_fit(hardware)
        except UserError as error:
            raise UserError(f"stage {row.stage.name}: {error}") from None


def execute(recipe: Recipe, run: Path, plan: Sequence[PlannedStage], console: Console) -> list[str]:
    """Run the plan; returns the names of the stages that ran. Safe to kill and start again at any moment.

    With several processes each calls this with the same plan: the lead runs and writes everything, the others
    only take part in trainings and in stages that share their work, and return after the last one.
    """
    todo = [row for row in plan if row.action in {"run", "resume"}]
    joint = [row for row in todo if row.stage.kind.trains or row.stage.kind.shares]
    require_fit(todo, recipe.hardware)
    leads = process_rank() == 0
    if not leads:
        todo = joint
    with _lock(run, needed=leads):
        team = Team.start(recipe.hardware) if joint else Team()
        if leads:
            write_text(run / "recipe.yaml", recipe.to_yaml(run))
            for row in plan:
                if row.action == "skip":
                    row.stage.kind.settle(row.stage.config, stage_folder(run, row.stage.name))
        for row in todo:
            stage, folder = row.stage, stage_folder(run, row.stage.name)
            begin = time.perf_counter()
            if leads:
                place = f"{plan.index(row) + 1}/{len(plan)}"
                console.print(f"[bold]\\[{place}] {stage.name}[/] ({stage.kind.summary})")
                _prepare(folder, row)
            perform(stage.kind, context_of(recipe, run, stage, folder, console, team), team, run)
            if leads:
                seconds = time.perf_counter() - begin
                took = {"seconds": round(seconds, 2), "hardware": recipe.hardware.describe()}
                write_json(folder / "timing.json", took)
                _artifact(recipe, run, row, plan).finish(folder)
                console.print(f"    finished in {seconds:.1f} s")
        team.part()
    return [row.stage.name for row in todo]


def context_of(
    recipe: Recipe, run: Path, stage: Stage, folder: Path, console: Console, team: Team
) -> StageContext:
    """What a stage works with in `folder`."""
    return StageContext(
        name=stage.name,
        recipe=recipe.name,
        config=stage.config,
        folder=folder,
        inputs=stage_inputs(recipe, run, stage),
        seed=recipe.seed_of(stage),
        hardware=recipe.hardware,
        console=console,
        shelf=Shelf(recipe.hardware.device()),
        rank=team.rank,
        world=team.world,
    )


def stage_inputs(recipe: Recipe, run: Path, stage: Stage) -> dict[str, Finished]:
    """The stages that feed one of a recipe, by role."""
    made: dict[str, Finished] = dict(recipe.outside)

    def finished(name: str) -> Finished:
        if name not in made:
            source = recipe.stage(name)
            inputs = {role: finished(above) for role, above in source.inputs.items()}
            gone = {role: said for (needing, role), said in recipe.gone.items() if needing == name}
            folder = stage_folder(run, name)
            made[name] = Finished(name, source.kind, source.config, folder, inputs, gone=gone)
        return made[name]

    return {role: finished(name) for role, name in stage.inputs.items()}


def begin(run: Path, row: PlannedStage) -> None:
    """Mark a stage of a plan as begun, so that parts of it can be made before it is run."""
    with _lock(run, needed=True):
        _prepare(stage_folder(run, row.stage.name), row)


def _prepare(folder: Path, row: PlannedStage) -> None:
    started = {"fingerprint": row.fingerprint, "extendable": row.extendable}
    prepare_folder(folder, started, anew=row.action == "run", start=row.start)


def _artifact(recipe: Recipe, run: Path, row: PlannedStage, plan: Sequence[PlannedStage]) -> Artifact:
    stage, rows = row.stage, {planned.stage.name: planned for planned in plan}
    return Artifact(
        stage=stage.name,
        kind=stage.kind.name,
        version=stage.kind.version,
        fingerprint=row.fingerprint,
        seed=recipe.seed_of(stage),
        config=stage.config.dump(),
        inputs={role: _input(recipe, run, row, rows, name) for role, name in stage.inputs.items()},
    )


def _input(
    recipe: Recipe, run: Path, row: PlannedStage, rows: Mapping[str, PlannedStage], name: str
) -> InputStage:
    """What an artifact says of an input; refuses one from outside that has changed since the plan."""
    if name in rows:
        return InputStage(stage=name, fingerprint=rows[name].fingerprint)
    folder = recipe.outside[name].folder
    now = identity_of(folder)
    if now != row.identities[name]:
        raise UserError(
            f"stage '{row.stage.name}': {folder} was made anew while this stage ran; run the recipe again"
        )
    return InputStage(stage=folder.name, fingerprint=now, folder=place_from(run, folder))


@contextmanager
def _lock(run: Path, needed: bool) -> Iterator[None]:
    """One writer a run folder; the lock goes with the process, so a kill leaves none behind."""
    if not needed:
        yield
        return
    run.mkdir(parents=True, exist_ok=True)
    with file_lock(run / ".lock", wait=False) as mine:
        if not mine:
            raise UserError(
                f"{run}: another motionloom process is working on this run; wait for it or stop it"
            )
        (run / ".lock").write_text(str(os.getpid()))
        yield
