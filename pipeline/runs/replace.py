"""What a run would replace of what is finished: nothing that took long is replaced unasked.

Guarded are trainings, whatever they took, and every other stage that took an hour or more, such as a long
conversion **[ours]**. The rest (statistics, tokens, figures, pages) is cheap and is made anew without asking.
`--from` and `--force` ask for the stages that they run again; `--replace` asks for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from motionloom.datasets.base.progress import duration
from motionloom.datasets.schema import UserError
from motionloom.pipeline.runs.graph import PlannedStage
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.store.run_state import read_record
from motionloom.pipeline.store.yaml import read_yaml

LONG_SECONDS = 3600.0
"""A stage that trains nothing is guarded from this time on."""


@dataclass(frozen=True)
class Replaced:
    """A finished stage that a plan would make anew though nobody has asked for it by name."""

    stage: str
    why: str
    trained: bool
    seconds: float | None
    """What it took, as its `timing.json` says; None where that was not noted."""

    def say(self) -> str:
        """One line."""
        work = "training" if self.trained else "work"
        took = f"{work} of unknown time" if self.seconds is None else f"{duration(self.seconds)} of {work}"
        return f"  {self.stage}: {self.why} ({took})"


def replaced_stages(run: Path, plan: Sequence[PlannedStage]) -> list[Replaced]:
    """Finished stages that are guarded and that the plan would replace."""
    out = []
    for row in plan:
        folder = stage_folder(run, row.stage.name)
        if row.action != "run" or row.asked or Artifact.find(folder) is None:
            continue
        trained, seconds = row.stage.kind.trains, _seconds(folder)
        if trained or (seconds or 0.0) >= LONG_SECONDS:
            out.append(Replaced(row.stage.name, row.reason, trained, seconds))
    return out


def started_trainings(run: Path, plan: Sequence[PlannedStage]) -> list[str]:
    """Trainings with checkpoints that the plan begins anew though nobody has asked for it by name."""
    return [
        row.stage.name
        for row in plan
        if row.action == "run"
        and row.stage.kind.trains
        and not row.asked
        and Artifact.find(stage_folder(run, row.stage.name)) is None
        and (stage_folder(run, row.stage.name) / "checkpoints").is_dir()
    ]


def say_replaced(run: Path, recipe: str, stages: Sequence[Replaced]) -> str | None:
    """Why a run is refused without `--replace`; None where it replaces nothing that is guarded."""
    other = _recipe_in(run, recipe)
    if other is None and not stages:
        return None
    lines = [f"{run}: holds a run of recipe '{other}', not '{recipe}'"] if other is not None else [f"{run}:"]
    if stages:
        known = [stage.seconds for stage in stages if stage.seconds is not None]
        total = f", {duration(sum(known))} of work" if known else ""
        joint = "; to go on here would" if other is not None else " this would"
        lines[0] += f"{joint} replace {len(stages)} finished stage{'s' * (len(stages) > 1)}{total}:"
        lines += [stage.say() for stage in stages]
    end = f"-o {_free(run)} keeps both, --replace goes on here: what fits is kept, the rest is made anew"
    return "\n".join([*lines, end]) if stages else f"{lines[0]}; {end}"


def require_asked(run: Path, recipe: str, stages: Sequence[Replaced]) -> None:
    """Refuse to replace what is guarded."""
    said = say_replaced(run, recipe, stages)
    if said is not None:
        raise UserError(said)


def _recipe_in(run: Path, name: str) -> str | None:
    """The recipe that a run folder holds, where it is another one."""
    path = run / "recipe.yaml"
    try:
        found = read_yaml(path) if path.is_file() else None
    except UserError:
        return None  # it is about to be written anew
    there = found.get("name", name) if isinstance(found, dict) else name
    return None if there == name else str(there)


def _free(run: Path) -> Path:
    """A folder beside this one that is not there yet."""
    return next(place for number in count(2) if not (place := Path(f"{run}-{number}")).exists())


def _seconds(folder: Path) -> float | None:
    path = folder / "timing.json"
    seconds = read_record(path).get("seconds") if path.is_file() else None
    return float(seconds) if isinstance(seconds, int | float) else None
