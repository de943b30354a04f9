"""Running a plan: each stage in order, by all processes that take part in it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import remove_temporaries, write_text
from motionloom.datasets.base.lock import LOCK_FILE, file_lock
from motionloom.models.training.distributed import alone
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    CompletedStage,
    Stage,
    StageCache,
    StageContext,
    StageKind,
)
from motionloom.pipeline.launch.console import say
from motionloom.pipeline.launch.process import beside, process_rank
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.runs.continuation import Started
from motionloom.pipeline.runs.plan import REQUEST_FILE, PlannedStage, doubts, require_fit, terms_of
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.runs.verify_shards import verify_shards
from motionloom.pipeline.store.artifact import Artifact, InputStage
from motionloom.pipeline.store.files import remove_tree, write_json
from motionloom.pipeline.store.run_folder import identity_of, place_from, require_own, stage_folder
from motionloom.pipeline.store.yaml import flatten

if TYPE_CHECKING:
    from motionloom.pipeline.runs.mirror import Mirror

LOCKS = ".locks"
"""In the run folder: a lock file for each stage."""


_DRAWING = (sys.executable, "-P", "-m", "motionloom.pipeline.runs.samples")
"""Draws motions of a training's newest checkpoint, in a process of its own."""


def execute(
    recipe: Recipe, run: Path, plan: Sequence[PlannedStage], console: Console, copies: Mirror | None = None
) -> list[str]:
    """Run the plan; returns the names of the stages that ran. Safe to kill and start again at any moment.

    With several processes each calls this with the same plan: the lead runs and writes everything, the others
    only take part in trainings and in stages that share their work, and return after the last one. A stage is
    sent to `copies` when it has begun, has another checkpoint and is finished; machines that share no disk
    have from there what the stages of all of them read.
    """
    todo = [row for row in plan if row.action in {"run", "resume"}]
    if recipe.hardware.part is not None:
        return _execute_part(recipe, run, plan, todo, console)
    heavy = any(row.stage.kind.heavy for row in todo)
    together = heavy or beside() > 1
    joint = [row for row in todo if together and (row.stage.kind.trains or row.stage.kind.shares)]
    require_fit((row.stage for row in todo), recipe.hardware)
    if heavy:
        recipe.hardware.require_devices()
    leads = process_rank() == 0
    if not leads:
        todo = joint  # all other stages run in the lead alone
    with _locks(run, recipe, todo) if leads else nullcontext():
        # All processes start before anything is written, so that they make the same plan.
        facts = facts_of(recipe, run, plan)
        if copies is not None:
            facts["the run folder"] = copies.store.place  # each machine may have its own
        team = copies.team if copies is not None else None
        if team is not None:
            team.agree(facts)
        else:
            team = Team.start(recipe.hardware, facts) if together else Team()
        send: Callable[[str], None] = _nowhere if copies is None else copies.send
        if leads and todo:
            said = doubts(recipe, run, (row.stage for row in todo))
            for doubt in said:
                say(console, doubt, "yellow")
            _begin(recipe, run, plan)
        for row in todo:
            stage = row.stage
            folder = stage_folder(run, row.stage.name)
            begin = time.perf_counter()
            if leads:
                place = f"{plan.index(row) + 1}/{len(plan)}"
                console.print(f"[bold]\\[{place}] {stage.name}[/] ({stage.kind.summary})")
                for doubt in doubts(recipe, run, [stage]):
                    if doubt not in said:  # of data that this run has made
                        say(console, f"    {doubt}", "yellow")
                _prepare(folder, row)
            context = context_of(recipe, run, stage, folder, console, team)
            if leads:
                send(stage.name)
                context = replace(context, begun=partial(_note, folder, row), saved=partial(send, stage.name))
            if copies is not None and row in joint:
                copies.spread([*_read_by(context, recipe), stage.name])
            perform(stage.kind, context, team, run, copies)
            if leads:
                seconds = time.perf_counter() - begin
                took = {"seconds": round(seconds, 2), "hardware": recipe.hardware.describe()}
                write_json(folder / "timing.json", took)
                # Last of all: a stage is finished when its artifact is there.
                _artifact(recipe, run, row, plan).finish(folder)
                send(stage.name)
                console.print(f"    finished in {seconds:.1f} s")
        if leads:
            (run / REQUEST_FILE).unlink(missing_ok=True)
    return [row.stage.name for row in todo]


def _nowhere(stage: str) -> None:
    """Send nothing: there is no mirror."""


def finish_stage(
    recipe: Recipe,
    run: Path,
    plan: Sequence[PlannedStage],
    row: PlannedStage,
    save: Callable[[Path], object],
    trained_by: str,
) -> None:
    """Have `save` write the files of a stage into its folder, and finish it as if it had run."""
    with _locks(run, recipe, [row]):
        _begin(recipe, run, plan)
        folder = stage_folder(run, row.stage.name)
        _prepare(folder, row)
        save(folder)
        artifact = _artifact(recipe, run, row, plan)
        artifact.model_copy(update={"trained_by": trained_by}).finish(folder)


def facts_of(recipe: Recipe, run: Path, plan: Sequence[PlannedStage]) -> dict[str, object]:
    """What all ranks must have alike: the run folder, every setting, and which stages are to be made."""
    facts = {"the run folder": str(run.absolute()), **flatten(recipe.tree(run))}
    # Who sees a checkpoint a moment later than others plans to `run`, not to `resume`: the lead decides that.
    for row in plan:
        facts[f"{row.stage.name}, to be made"] = row.action in {"run", "resume"}
        facts[f"{row.stage.name}, its inputs and code"] = row.fingerprint
    return {key.removeprefix("stages."): value for key, value in facts.items()}


def _execute_part(
    recipe: Recipe, run: Path, plan: Sequence[PlannedStage], todo: Sequence[PlannedStage], console: Console
) -> list[str]:
    """Make one part of each conversion, which a run without a part then joins and finishes."""
    for row in todo:
        if not row.stage.kind.parts:
            raise UserError(
                f"hardware.part is {recipe.hardware.part}, and stage '{row.stage.name}' cannot be made in "
                f"parts; name stages that convert with --until"
            )
    with _locks(run, recipe, todo, shared=True):
        _begin(recipe, run, plan)
        for row in todo:
            folder = stage_folder(run, row.stage.name)
            console.print(
                f"[bold]{row.stage.name}[/], part {recipe.hardware.part} ({row.stage.kind.summary})"
            )
            with file_lock(run / LOCK_FILE):  # the first of the parts prepares the folder for all
                before = Started.find(folder)
                if before is None or before.fingerprint != row.fingerprint:
                    _prepare(folder, row)
            row.stage.kind.run(context_of(recipe, run, row.stage, folder, console, Team()))
    return [row.stage.name for row in todo]


def perform(
    kind: StageKind, context: StageContext, team: Team, run: Path, copies: Mirror | None = None
) -> None:
    """One stage of `run`, by all processes that take part in its kind."""
    if kind.trains:
        verify_shards(context, team, run)
        kind.run(context)
        return
    with alone():
        if kind.shares:
            verify_shards(context, team, run)
            kind.share(context)
            team.meet()
            if copies is not None:
                copies.collect(context.name)
        elif team.leads:
            verify_shards(context, Team(), run)
        if team.leads:
            kind.run(context)


def context_of(
    recipe: Recipe,
    run: Path,
    stage: Stage,
    folder: Path,
    console: Console,
    team: Team,
    stage_cache: StageCache | None = None,
) -> StageContext:
    """The context of a stage that works in `folder`."""
    return StageContext(
        name=stage.name,
        recipe=recipe.name,
        config=stage.config,
        folder=folder,
        inputs=stage_inputs(recipe, run, stage),
        seed=recipe.seed,
        hardware=recipe.hardware,
        console=console,
        stage_cache=StageCache(recipe.hardware.device()) if stage_cache is None else stage_cache,
        rank=team.rank,
        world=team.world,
        draws=_DRAWING if draws_motions(recipe, stage) else (),
    )


def draws_motions(recipe: Recipe, stage: Stage) -> bool:
    """Whether a stage generates, or is the last input of one that trains nothing and does (UDE's DMD)."""
    before = {one.name for one in recipe.stages[: recipe.stages.index(stage) + 1]} | recipe.outside.keys()
    for one in recipe.stages:
        last = (
            not one.kind.trains and stage.name in one.inputs.values() and before >= set(one.inputs.values())
        )
        if GENERATOR in one.kind.gives(one.config) and (one is stage or last):
            return True
    return False


def _read_by(context: StageContext, recipe: Recipe) -> list[str]:
    """Names of the stages of this run that one is made from, sorted."""
    read = {above.name for source in context.inputs.values() for above in (source, *source.upstream())}
    return sorted(read - recipe.outside.keys())


def stage_inputs(recipe: Recipe, run: Path, stage: Stage) -> dict[str, CompletedStage]:
    """The stages that feed one of a recipe, by role."""
    stages: dict[str, CompletedStage] = dict(recipe.outside)

    def finished(name: str) -> CompletedStage:
        if name not in stages:
            source = recipe.stage(name)
            inputs = {role: finished(above) for role, above in source.inputs.items()}
            stages[name] = CompletedStage(name, source.kind, source.config, stage_folder(run, name), inputs)
        return stages[name]

    return {role: finished(name) for role, name in stage.inputs.items()}


def _prepare(folder: Path, row: PlannedStage) -> None:
    if row.action == "run":
        remove_tree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # A training that cannot load its checkpoint with other settings stays what it was.
    if row.action == "run" or not row.stage.kind.trains:
        _note(folder, row)


def _note(folder: Path, row: PlannedStage) -> None:
    """Note what is being made in a folder; a training that goes on is not finished any more."""
    write_json(folder / "started.json", row.started.dump())
    (folder / "artifact.json").unlink(missing_ok=True)


def _artifact(recipe: Recipe, run: Path, row: PlannedStage, plan: Sequence[PlannedStage]) -> Artifact:
    stage = row.stage
    rows = {planned.stage.name: planned for planned in plan}
    inputs = {role: _input(recipe, run, row, rows, name) for role, name in stage.inputs.items()}
    return Artifact(
        stage=stage.name,
        kind=stage.kind.name,
        version=stage.kind.version,
        fingerprint=row.fingerprint,
        seed=recipe.seed,
        config=stage.config.dump(),
        code=dict(row.code),
        changed=row.started.changed,
        inputs=inputs,
        terms=terms_of(stage, stage_folder(run, stage.name), inputs.values()),
    )


def _input(
    recipe: Recipe, run: Path, row: PlannedStage, rows: Mapping[str, PlannedStage], name: str
) -> InputStage:
    """The record of an input in an artifact; refuses one from outside that has changed since the plan."""
    if name in rows:
        return InputStage(stage=name, fingerprint=rows[name].fingerprint)
    folder = recipe.outside[name].folder
    now = identity_of(folder)
    if now != row.identities[name]:
        raise UserError(
            f"stage '{row.stage.name}': {folder} was made again while this stage ran; run the recipe again"
        )
    return InputStage(stage=folder.name, fingerprint=now, folder=place_from(run, folder))


def _begin(recipe: Recipe, run: Path, plan: Sequence[PlannedStage]) -> None:
    """Write what belongs to the whole run."""
    with file_lock(run / LOCK_FILE):  # other jobs of the run write here too
        remove_temporaries(run)
        write_text(run / "recipe.yaml", recipe.to_yaml(run))
        asked = [row for row in plan if row.again is not None]
        for row in asked:
            if row.action == "run":
                remove_tree(stage_folder(run, row.stage.name))
        if asked:  # behind the removal: a command that is killed before this begins again
            write_json(run / REQUEST_FILE, asked[0].again)
        else:
            (run / REQUEST_FILE).unlink(missing_ok=True)
        for row in plan:
            if row.action == "skip":
                row.stage.kind.settle(row.stage.config, stage_folder(run, row.stage.name))


@contextmanager
def _locks(
    run: Path, recipe: Recipe, todo: Sequence[PlannedStage], *, shared: bool = False
) -> Iterator[None]:
    """Hold each stage that is to be made, `shared` with other parts of it, and with other readers those that
    they are made from.

    Jobs that share no stage thus work in one run folder at once. Locks end with their process, even a killed
    one.
    """
    run.mkdir(parents=True, exist_ok=True)
    require_own(run)
    (run / LOCKS).mkdir(exist_ok=True)
    made = {row.stage.name for row in todo}
    read = {above.name for row in todo for above in recipe.above(row.stage)} - made
    with ExitStack() as stack:
        for name in sorted(made | read):
            if not stack.enter_context(
                file_lock(run / LOCKS / name, wait=False, shared=shared or name in read)
            ):
                raise UserError(
                    f"{run}: another motionloom process is working on this run's stage '{name}'; wait for "
                    f"it or stop it"
                )
        yield
