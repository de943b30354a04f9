"""The runs that are compared: their names, how far they are, where their figures are, what differs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.figures import FILE_NAME, FigureFile
from motionloom.pipeline.store.run_state import RunState, StageState, run_state
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.store.yaml import flatten

MOST = 8
"""Runs on one page: as many as there are colours."""


@dataclass(frozen=True)
class ComparedRun:
    """One of the runs that are compared."""

    label: str
    colour: int
    state: RunState

    @cached_property
    def logs(self) -> dict[str, list[dict[str, float]]]:
        """Rows of the training log of each stage that has one."""
        rows = {stage.name: read_training_log(stage.folder) for stage in self.state.stages}
        return {name: log for name, log in rows.items() if log}

    @cached_property
    def files(self) -> dict[str, Path]:
        """Files of figures by stage: of `motionloom evaluate` where that is newer than all that the run has
        made, else of the run.
        """
        out = {}
        for stage in self.state.stages:
            path = stage.folder / FILE_NAME
            if stage.usable and path.is_file():
                out[stage.name] = path
        for path in sorted((self.state.folder / "evaluate").rglob(FILE_NAME)):
            if self._newest() < path.stat().st_mtime_ns:
                out[str(FigureFile.read(path).about.get("stage"))] = path
        return {stage.name: out[stage.name] for stage in self.state.stages if stage.name in out}

    @cached_property
    def evaluations(self) -> dict[str, FigureFile]:
        return {name: FigureFile.read(path) for name, path in self.files.items()}

    def _newest(self) -> int:
        """When the last stage was finished that figures may depend on; pages do not change them."""
        artifacts = [
            s.folder / "artifact.json" for s in self.state.stages if s.kind not in ("report", "generate")
        ]
        return max((path.stat().st_mtime_ns for path in artifacts if path.is_file()), default=0)


def open_runs(folders: Sequence[Path]) -> list[ComparedRun]:
    """Read the runs; a `UserError` says what is none, or what cannot be compared."""
    if len(folders) < 2:
        raise UserError("name two runs or more, like: motionloom compare runs/first runs/second")
    if len(folders) > MOST:
        raise UserError(f"{len(folders)} runs: one page compares at most {MOST}; leave some out")
    places = [folder.resolve() for folder in folders]
    for folder, place in zip(folders, places, strict=True):
        if places.count(place) > 1:
            raise UserError(f"{folder}: is named twice; compare it with another run")
    names = _labels(places)
    return [
        ComparedRun(label, number, run_state(folder))
        for number, (label, folder) in enumerate(zip(names, folders, strict=True))
    ]


def _labels(places: Sequence[Path]) -> list[str]:
    """The last names of the folders, and as many of those above as tell them apart."""
    for depth in range(1, max(len(place.parts) for place in places) + 1):
        names = ["/".join(place.parts[-depth:]) for place in places]
        if len(set(names)) == len(names):
            return names
    return [str(place) for place in places]


# Settings in which runs differ, stage by stage.


ABSENT = "(absent)"
"""Stands for a setting that a run does not have."""


@dataclass(frozen=True)
class StageDifferences:
    """Settings of one stage that differ between runs; the stage "" is the recipe itself."""

    stage: str
    missing: tuple[str, ...]
    """Runs whose recipe has no such stage."""
    differences: Mapping[str, tuple[object, ...]]
    """Setting -> its value in each run, in the runs' order; `ABSENT` where a run does not have it."""


def stage_names(runs: Sequence[ComparedRun]) -> list[str]:
    """Stages of all runs, in the order of the first that has them."""
    return list(dict.fromkeys(stage.name for run in runs for stage in run.state.stages))


def setting_differences(runs: Sequence[ComparedRun]) -> list[StageDifferences]:
    """Differences of the recipes, then of each stage; stages that are equal in all runs are left out.

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
        settings = [_settings(stage) for stage in stages]
        out.append(StageDifferences(name, missing, _differences(settings)))
    return [stage for stage in out if stage.missing or stage.differences]


def _settings(stage: StageState | None) -> Mapping[str, object] | None:
    if stage is None:
        return None
    return {"kind": stage.kind, **flatten({"inputs": stage.inputs}), **flatten(stage.settings)}


def _differences(each: Sequence[Mapping[str, object] | None]) -> dict[str, tuple[object, ...]]:
    """Keys whose values are not equal in all of `each` that are there."""
    present = [settings for settings in each if settings is not None]
    out = {}
    for key in dict.fromkeys(key for settings in present for key in settings):
        values = [settings.get(key, ABSENT) for settings in present]
        # Python takes 1 and true for equal.
        if any(
            value != values[0] or isinstance(value, bool) != isinstance(values[0], bool) for value in values
        ):
            out[key] = tuple(ABSENT if settings is None else settings.get(key, ABSENT) for settings in each)
    return out
