"""The plan of a run and the cost of its trainings, before anything runs: tables for people, a record for
programs (`motionloom run --dry-run`, with `--json`).

Nothing that took long is replaced unless the user asks for it. Guarded are finished trainings, whatever they
took, unfinished ones after ten minutes, and every other stage that took an hour or more, such as a long
conversion **[ours]**. The rest (statistics, tokens, figures, pages) is cheap and runs again without asking.
`--from` asks for the stages that it runs again; `--replace` asks for all.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from statistics import median

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom import models, pipeline
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_json
from motionloom.datasets.base.progress import duration
from motionloom.pipeline.contract.lookup import preview_of, previews
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.runs.continuation import newest_step
from motionloom.pipeline.runs.plan import PlannedStage
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.files import fingerprint_of, read_record
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.store.training_log import read_flight, seconds_trained
from motionloom.pipeline.store.yaml import read_yaml


def plan_table(recipe: Recipe, plan: Sequence[PlannedStage] = ()) -> Table:
    """The plan as a table for people; without one, where data are missing, the stages alone."""
    table = Table(title=escape(f"{recipe.name}: {len(recipe.stages)} stages"), title_justify="left")
    for column in ("stage", "kind", "action", "why", "from"):
        table.add_column(column, overflow="fold")
    colours = {"run": "yellow", "resume": "cyan", "skip": "green", "leave": "dim"}
    planned = {
        row.stage.name: (f"[{colours[row.action]}]{row.action}[/]", escape(row.reason)) for row in plan
    }
    for stage in recipe.stages:
        inputs = ", ".join(dict.fromkeys(stage.inputs.values()))
        table.add_row(stage.name, stage.kind.name, *planned.get(stage.name, ("?", "")), escape(inputs))
    return table


class Sizes(Config):
    """`sizes.json` in the user's cache: estimates, which take seconds, by all that they depend on."""

    cards: dict[str, ModelCard | None]
    """None of a training that fits its inputs and was not measured."""

    @staticmethod
    def place() -> Path:
        cache = os.environ.get("XDG_CACHE_HOME")
        return (Path(cache) if cache else Path.home() / ".cache") / "motionloom" / "sizes.json"

    @staticmethod
    def read() -> Sizes:
        """The stored sizes; none where none can be read."""
        try:
            return Sizes.load_json(Sizes.place())
        except (UserError, OSError):
            return Sizes(cards={})

    def write(self, cards: Mapping[str, ModelCard | None]) -> None:
        """Store the sizes with new ones, the newest `_MOST` of all."""
        newest = dict([*self.cards.items(), *cards.items()][-_MOST:])
        with suppress(OSError):  # a home that may only be read
            write_json(Sizes.place(), Sizes(cards=newest).dump())


_MOST = 500


def estimate(
    recipe: Recipe,
    names: Collection[str] | None = None,
    plan: Sequence[PlannedStage] = (),
    *,
    measure: bool = True,
) -> dict[str, ModelCard]:
    """A card for each stage that trains, of `names` or of all; `UserError` when the layout of the data is not
    known, or a network does not fit its inputs. Those of a `plan` are remembered from the last time; without
    `measure`, which takes seconds, there are no others.
    """
    stages = {stage.name: stage for stage in recipe.stages} | dict(recipe.outside)
    known = Sizes.read()
    keys = {row.stage.name: _key(recipe, row) for row in plan}
    cards: dict[str, ModelCard] = {}
    new: dict[str, ModelCard | None] = {}
    for stage in recipe.stages:
        if not stage.kind.trains or (names is not None and stage.name not in names):
            continue
        key = keys.get(stage.name, "")
        card = known.cards.get(key)
        if card is None and (measure or key not in known.cards):
            inputs = previews(stage, stages)
            try:
                if measure:
                    card = stage.kind.estimate(stage.config, inputs, recipe.hardware)
                else:
                    stage.kind.require_inputs(stage.config, inputs)
            except UserError as error:
                raise UserError(f"stage {stage.name}: {error}") from None
            if key:
                new[key] = card
        if card is not None:
            cards[stage.name] = card
    if new:
        known.write(new)
    return cards


def _key(recipe: Recipe, row: PlannedStage) -> str:
    """Digest of all that a stage's sizes depend on: fingerprint, settings that are none of it, code."""
    train = row.stage.config.dump().get("train")
    return fingerprint_of([row.fingerprint, train, recipe.hardware.world(), torch.__version__, _code()])


@cache
def _code() -> list[int]:
    """Number of our files that sizes may depend on, and the time of their last change."""
    files = [path for package in (models, pipeline) for path in Path(package.__path__[0]).rglob("*.py")]
    return [len(files), max(path.stat().st_mtime_ns for path in files)]


def training_times(run: Path, rows: Sequence[PlannedStage]) -> dict[str, float]:
    """Seconds that are left of the trainings in `rows`, by the run's own telemetry; others are not known."""
    out = {}
    for row in (row for row in rows if row.stage.kind.trains):
        flights = read_flight(stage_folder(run, row.stage.name)).get(0, ())
        measured = [one["step_seconds"] for one in flights if "step_seconds" in one]
        done = max((int(one["step"]) for one in flights), default=0) if row.action == "resume" else 0
        if measured:
            left = max(0, row.stage.config.train.steps - done)
            out[row.stage.name] = median(measured) * left
    return out


def estimate_table(cards: Mapping[str, ModelCard], times: Mapping[str, float]) -> Table:
    """The estimates as a table for a terminal."""
    table = Table(title="what the trainings take (one process)", title_justify="left")
    for column in ("stage", "parameters", "batch", "steps", "time", "memory", "checkpoints", "tokens"):
        table.add_column(column, overflow="fold")
    for name, card in cards.items():
        parameters = _count(card.parameters)
        if card.codebook:
            parameters += f" + {_count(card.codebook)} codebook"
        took = f"about {duration(times[name])}" if name in times else "not known here"
        memory = _size(card.memory_bytes)
        disk = _size(card.checkpoint_bytes)
        once = f" ({card.local_batch} at once)" if card.local_batch < card.batch else ""
        cells = f"{card.batch}{once}", f"{card.steps:,}", took, memory, disk, card.note
        table.add_row(name, parameters, *cells)
    return table


def _count(number: int) -> str:
    return f"{number / 1e6:.1f} M" if number >= 1e5 else f"{number / 1e3:.1f} k"


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 / 10 else f"{count / 2**20:.1f} MiB"


def say_estimate(
    recipe: Recipe,
    console: Console,
    run: Path | None = None,
    todo: Sequence[PlannedStage] | None = None,
    *,
    measure: bool = True,
) -> None:
    """Print what the trainings among `todo` (None = all) take, where the recipe says enough; without
    `measure` as far as it was measured before.
    """
    named = [row.stage for row in todo] if todo is not None else list(recipe.stages)
    trained = [stage.name for stage in named if stage.kind.trains]
    if not trained:
        return
    stages = {stage.name: stage for stage in recipe.stages}
    for stage in recipe.stages:
        if "data" not in stage.kind.gives(stage.config):
            continue
        try:
            preview_of(stage, {**stages, **recipe.outside})
        except UserError as error:
            if todo is not None:  # else the plan has said it
                console.print(str(error), markup=False)
            return
    cards = estimate(recipe, trained, todo or (), measure=measure)
    if todo is not None and (unknown := [name for name in trained if name not in cards]):
        console.print(f"not measured yet: {', '.join(unknown)}; --sizes says what they take", markup=False)
    if not cards:
        return
    times = {} if run is None or todo is None else training_times(run, todo)
    console.print(estimate_table(cards, times))
    total = sum(times.values())
    lines = [f"disk: {_size(sum(card.checkpoint_bytes for card in cards.values()))} for checkpoints"]
    lines += [f"trainings: about {duration(total)} on {recipe.hardware.describe()}"] if times else []
    console.print("; ".join(lines), markup=False)


# What a run would replace.

LONG_SECONDS = 3600.0
"""A stage that trains nothing is guarded from this time on."""
TRAINED_SECONDS = 600.0
"""A training that is not finished is guarded from this time on."""


@dataclass(frozen=True)
class Replaced:
    """A guarded stage that a plan would run again although the user did not name it."""

    stage: str
    why: str
    trained: bool
    seconds: float | None
    """From its `timing.json`, of a training by its telemetry too; None where none was noted."""
    goes_on: str = ""
    """How it would go on with `--go-on`, in words; "" where it cannot."""

    def say(self) -> str:
        work = "training" if self.trained else "work"
        took = f"{work} of unknown time" if self.seconds is None else f"{duration(self.seconds)} of {work}"
        how = f"; --go-on {self.stage}: {self.goes_on}" if self.goes_on else ""
        return f"  {self.stage}: {self.why} ({took}){how}"


def replaced_stages(run: Path, plan: Sequence[PlannedStage]) -> list[Replaced]:
    """Stages that are guarded and that the plan would replace."""
    out = []
    for row in plan:
        folder = stage_folder(run, row.stage.name)
        trained = row.stage.kind.trains
        if row.action != "run" or row.again is not None:
            continue
        if Artifact.find(folder) is not None:
            seconds = _seconds(folder)
            if trained and (whole := seconds_trained(folder)):  # the noted time is of the last process alone
                seconds = max(seconds or 0.0, whole)
            guarded = trained or (seconds or 0.0) >= LONG_SECONDS
        else:
            seconds = seconds_trained(folder)
            guarded = trained and seconds >= TRAINED_SECONDS and newest_step(folder) is not None
        if guarded:
            how = "" if row.goes_on is None else row.goes_on.reason
            out.append(Replaced(row.stage.name, row.reason, trained, seconds, how))
    return out


def explain_replacements(run: Path, recipe: str, stages: Sequence[Replaced]) -> str | None:
    """Why a run is refused without `--replace`; None where it replaces nothing that is guarded."""
    other = _recipe_in(run, recipe)
    if other is None and not stages:
        return None
    lines = [f"{run}: holds a run of recipe '{other}', not '{recipe}'"] if other is not None else [f"{run}:"]
    if stages:
        seconds = [stage.seconds for stage in stages if stage.seconds is not None]
        total = f", {duration(sum(seconds))} of work" if seconds else ""
        joint = "; to go on here would" if other is not None else " this would"
        lines[0] += f"{joint} replace {len(stages)} stage{'s' * (len(stages) > 1)}{total}:"
        lines += [stage.say() for stage in stages]
    end = f"-o {_free(run)} keeps both, --replace goes on here: what fits is kept, the rest is made again"
    if other is None:
        again = f"motionloom run {run}/recipe.yaml -o {run}"
        lines.append(f"with the settings of the last run here, --set too: {again}")
    return "\n".join([*lines, end]) if stages else f"{lines[0]}; {end}"


def _recipe_in(run: Path, name: str) -> str | None:
    """The recipe that a run folder holds, where it is another one."""
    path = run / "recipe.yaml"
    try:
        recipe = read_yaml(path) if path.is_file() else None
    except UserError:
        return None  # it is about to be written again
    held = recipe.get("name", name) if isinstance(recipe, dict) else name
    return None if held == name else str(held)


def _free(run: Path) -> Path:
    """A free name for another run folder."""
    return next(place for number in count(2) if not (place := Path(f"{run}-{number}")).exists())


def _seconds(folder: Path) -> float | None:
    path = folder / "timing.json"
    seconds = read_record(path).get("seconds") if path.is_file() else None
    return float(seconds) if isinstance(seconds, int | float) else None
