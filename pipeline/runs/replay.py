"""`motionloom replay`: repeat the step that a crash bundle is about, from the checkpoint before it.

The training runs as it ran, in as many processes, on the same batches and draws, in a folder of its own
within the bundle; nothing of the run is touched.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.flight.replay import ReplayDone, ReplaySteps
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import TeamError
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.runs.graph import context_of, make_plan
from motionloom.pipeline.runs.perform import perform
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.stages.train_config import TrainConfig
from motionloom.pipeline.store.crash import (
    CHECKPOINT,
    CrashRecord,
    read_batch,
    read_bundle,
    same_batch,
)
from motionloom.pipeline.store.files import link_or_copy, remove_tree
from motionloom.pipeline.store.run_folder import require_run

_SCRATCH = "replay"


def replay_crash(bundle: Path, *, anomaly: bool = False, console: Console | None = None) -> bool:
    """Repeat the step of a crash bundle and say what it gives; whether it failed again.

    With `anomaly` torch's anomaly mode looks into that step, and the first layer whose output is not finite
    is named.
    """
    console = console or make_console()
    record = read_bundle(bundle)
    run, recipe, stage = _stage_of(bundle, record)
    train: TrainConfig = stage.config.train
    team = Team.start(recipe.hardware)
    scratch = bundle / _SCRATCH
    if team.leads:
        remove_tree(scratch)
        scratch.mkdir()
        if record.checkpoint is not None:
            name = f"step={record.checkpoint.step:08d}.ckpt"
            link_or_copy(bundle / CHECKPOINT, scratch / "checkpoints" / name)
    team.meet()
    steps = ReplaySteps(record.step, train.accumulate, anomaly=anomaly)
    context = replace(
        context_of(recipe, run, stage, scratch, console, team),
        config=_without_validation(stage.config),
        watched_by=(steps,),
    )
    say: Any = console.print
    if team.world > 1:  # the process that failed has seen it; the others are silent
        mine = team.rank == record.rank
        say = partial(Console(quiet=not mine, highlight=False, width=120).print)
    say(f"{record.said}", markup=False, soft_wrap=True)
    error: Exception | None = None
    try:
        perform(stage.kind, context, team, run)
    except ReplayDone:
        pass
    except UserError:
        raise
    except Exception as found:  # the failure itself, most likely
        error = found
    finally:
        if team.leads:
            remove_tree(scratch)
    return _say(record, steps, error, read_batch(bundle), say)


def _stage_of(bundle: Path, record: CrashRecord) -> tuple[Path, Recipe, Stage]:
    """The run of a bundle, its recipe on the hardware of the crash, and the stage as it was."""
    run = bundle.resolve().parents[3]
    if record.fingerprint is None:
        raise UserError(f"{bundle}: of a training outside of a run, which `motionloom replay` cannot repeat")
    require_run(run)
    recipe = load_recipe(run / "recipe.yaml", strict=False)
    hardware = {**record.hardware, "loggers": [], "profile": 0}
    recipe = replace(recipe, hardware=Hardware.parse(hardware, f"{bundle}/crash.json: hardware"))
    if recipe.hardware.world() != record.world:
        recipe = replace(
            recipe, hardware=recipe.hardware.model_copy(update={"devices": record.world, "nodes": 1})
        )
    stage = recipe.stage(record.stage)
    now = next(row.fingerprint for row in make_plan(recipe, run) if row.stage.name == stage.name)
    if now != record.fingerprint:
        raise UserError(
            f"{bundle}: stage {stage.name} of {run / 'recipe.yaml'} has other settings or inputs now than "
            f"when it failed; put them back to replay it"
        )
    return run, recipe, stage


def _without_validation(config: Any) -> Any:
    """A validation changes nothing of the training, and takes time."""
    return config.model_copy(update={"train": config.train.model_copy(update={"validate_every": 0})})


def _say(
    record: CrashRecord,
    steps: ReplaySteps,
    error: Exception | None,
    batch: Mapping[str, Any] | None,
    say: Any,
) -> bool:
    last = steps.figures.get(record.step, {})
    say(f"repeated steps {steps.first + 1} to {record.step}")
    if batch is not None and steps.batch:
        same = "the same" if same_batch(batch, steps.batch) else "another one than"
        say(f"its batch is {same}{' as' if same == 'the same' else ''} in the bundle")
    if steps.lost:
        say(f"weights that were not finite before it: {', '.join(steps.lost)}", markup=False)
    if last:
        say(_table("losses and metrics", last))
    if steps.norms:
        say(_table("gradient norms", {name: [norm] for name, norm in steps.norms.items()}))
    if steps.first_layers:
        say(f"first layers whose output is not finite: {'; '.join(steps.first_layers[:3])}", markup=False)
    if error is not None:
        say(f"{type(error).__name__}: {error}", markup=False, soft_wrap=True)
    again, how = _outcome(record, steps, error)
    say(f"the failure {'came' if again else 'did not come'} again{how}", markup=False)
    return again


def _outcome(record: CrashRecord, steps: ReplaySteps, error: Exception | None) -> tuple[bool, str]:
    if isinstance(error, TeamError):
        return True, ""  # it came in another process
    before = next((one.figures for one in record.steps if one.step == record.step), {})
    now = steps.figures.get(record.step, {})
    if record.kind == "exception":
        again = error is not None and f"{type(error).__name__}: {error}" == record.error
        return again, "" if again or error is None else ", but another error did"
    values = [*steps.norms.values(), *(value for own in now.values() for value in own)]
    again = error is not None or not all(map(math.isfinite, values))
    if not before or not now:
        return again, ""
    return again, ", with the same figures to the bit" if _equal(before, now) else ", with other figures"


def _equal(one: dict[str, list[float]], other: dict[str, list[float]]) -> bool:
    return one.keys() == other.keys() and all(
        len(one[name]) == len(other[name])
        and all(a == b or (a != a and b != b) for a, b in zip(one[name], other[name], strict=True))
        for name in one
    )


def _table(title: str, rows: Mapping[str, list[float]]) -> Table:
    table = Table(title=title, title_justify="left", show_header=False)
    for name, values in rows.items():
        style = None if all(map(math.isfinite, values)) else "red"
        table.add_row(name, *(f"{value:.9g}" for value in values), style=style)
    return table
