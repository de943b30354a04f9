"""The runs that are compared: their names, how far they are, and where their figures lie."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.outside import owner_of
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.store.run_state import RunState, StageState, read_record, run_state
from motionloom.pipeline.store.training_log import read_training_log

MOST = 8
"""Runs on one page: as many as there are colours."""
FILES = {"evaluate": "metrics.json", "evaluate_dances": "dances.json"}
"""Where stages of a kind write their figures."""


@dataclass(frozen=True)
class FigureFile:
    """The figures of one evaluation of a run."""

    stage: str
    kind: str
    path: Path
    figures: Mapping[str, Any]
    settings: Mapping[str, Any]
    """Of the stage, as its recipe has them."""
    version: int | None
    """Of the stage's kind; None where that was not noted."""
    data: str
    """Tells the data set from others; equal data made by other recipes may differ."""


@dataclass(frozen=True)
class ComparedRun:
    """One of them."""

    label: str
    colour: int
    state: RunState

    @cached_property
    def logs(self) -> dict[str, list[dict[str, float]]]:
        """Rows of the training log of each stage that has one."""
        rows = {stage.name: read_training_log(stage.folder) for stage in self.state.stages}
        return {name: log for name, log in rows.items() if log}

    @cached_property
    def evaluations(self) -> dict[str, FigureFile]:
        """Figures by stage."""
        stages = [stage for stage in self.state.stages if stage.kind in FILES]
        stages.sort(key=lambda stage: stage.kind != "evaluate")  # `motionloom evaluate` sorts them so
        found = {}
        for number, stage in enumerate(stages):
            file = self._figures(stage, again=self.state.folder / "evaluate" / (stage.name if number else ""))
            if file is not None:
                found[stage.name] = file
        return found

    def _figures(self, stage: StageState, again: Path) -> FigureFile | None:
        """Of `motionloom evaluate` where that is newer than all that the run has made, else of the run."""
        name = FILES[stage.kind]
        path, version = stage.folder / name, stage.artifact.version if stage.artifact else None
        if (again / name).is_file() and self._newest() < (again / name).stat().st_mtime_ns:
            path = again / name
        elif not stage.usable or not path.is_file():
            return None
        figures = read_record(path)
        version = figures.get("version", None if path.parent == again else version)
        return FigureFile(stage.name, stage.kind, path, figures, stage.settings, version, self._data(stage))

    def _newest(self) -> int:
        """When the last stage was finished that figures may depend on; pages do not change them."""
        made = [s.folder / "artifact.json" for s in self.state.stages if s.kind not in ("report", "generate")]
        return max((path.stat().st_mtime_ns for path in made if path.is_file()), default=0)

    def _data(self, stage: StageState) -> str:
        run = self.state.folder
        source = stage.artifact.inputs.get("data") if stage.artifact else None
        return _identity(stage_folder(run, "data") if source is None else source.place(run), set())


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


def _identity(folder: Path, seen: set[Path]) -> str:
    """A digest of the shards that a data stage wrote and of the stages it mixes; else its fingerprint.

    Two recipes that make the same clips have other fingerprints, by their seed or by unused settings.
    """
    artifact = None if folder in seen else Artifact.find(folder)
    if artifact is None:
        return f"unknown data of {folder}"
    run = owner_of(folder)
    above = [_identity(source.place(run), seen | {folder}) for source in artifact.inputs.values()]
    if not above and not any(output.endswith(".tar") for output in artifact.outputs):
        return artifact.fingerprint
    facts = [sorted((name, output.sha256) for name, output in artifact.outputs.items()), above]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()
