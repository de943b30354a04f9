"""Settings in which runs differ, stage by stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from motionloom.pipeline.compare.runs import ComparedRun
from motionloom.pipeline.store.flatten import flatten
from motionloom.pipeline.store.run_state import StageState


class Absent:
    """Stands for a setting that a run does not have."""

    def __repr__(self) -> str:
        return "absent"


ABSENT = Absent()


@dataclass(frozen=True)
class Difference:
    """A setting, and its value in each run, in the runs' order; `ABSENT` where a run does not have it."""

    key: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class StageDifferences:
    """What differs of one stage; "" is the recipe itself."""

    stage: str
    missing: tuple[str, ...]
    """Runs whose recipe has no such stage."""
    differences: tuple[Difference, ...]


def stage_names(runs: Sequence[ComparedRun]) -> list[str]:
    """Stages of all runs, in the order of the first that has them."""
    return list(dict.fromkeys(stage.name for run in runs for stage in run.state.stages))


def setting_differences(runs: Sequence[ComparedRun]) -> list[StageDifferences]:
    """What differs: of the recipes, then of each stage; stages that are equal in all runs are left out.

    A finished stage has the settings that made it, which its recipe may have changed since.
    """
    recipes = [
        {
            "recipe": run.state.recipe,
            "seed": run.state.seed,
            "data_seed": run.state.data_seed,
            **flatten({"hardware": run.state.hardware}),
        }
        for run in runs
    ]
    out = [StageDifferences("", (), _differences(recipes))]
    for name in stage_names(runs):
        stages = [run.state.stage(name) for run in runs]
        missing = tuple(run.label for run, stage in zip(runs, stages, strict=True) if stage is None)
        there = [_settings(stage) for stage in stages]
        out.append(StageDifferences(name, missing, _differences(there)))
    return [stage for stage in out if stage.missing or stage.differences]


def _settings(stage: StageState | None) -> Mapping[str, Any] | None:
    if stage is None:
        return None
    return {"kind": stage.kind, **flatten({"inputs": stage.inputs}), **flatten(stage.settings)}


def _differences(each: Sequence[Mapping[str, Any] | None]) -> tuple[Difference, ...]:
    """Keys whose values are not equal in all of `each` that are there."""
    there = [settings for settings in each if settings is not None]
    out = []
    for key in dict.fromkeys(key for settings in there for key in settings):
        found = [settings.get(key, ABSENT) for settings in there]
        # Python takes 1 and true for equal.
        if any(value != found[0] or isinstance(value, bool) != isinstance(found[0], bool) for value in found):
            values = tuple(ABSENT if settings is None else settings.get(key, ABSENT) for settings in each)
            out.append(Difference(key, values))
    return tuple(out)
