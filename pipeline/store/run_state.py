"""A run read from its files alone: its finished stages and how far the others are.

No stage is loaded and torch is not imported. Everything that reads a run begins here: `contract/lookup.py`
makes stages of these records that can be loaded, the report and the papers' tables take them as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.store.artifact import Artifact, Changed, changed_above
from motionloom.pipeline.store.files import read_record
from motionloom.pipeline.store.run_folder import (
    BUNDLE_FILE,
    in_export,
    label_of,
    owner_of,
    require_run,
    stage_folder,
    stages_of,
)
from motionloom.pipeline.store.yaml import read_yaml

Progress = Literal["finished", "outdated", "started", "missing"]


@dataclass(frozen=True)
class StageRecord:
    """A finished stage: its kind, its config with every default, and the stages that fed it, by role."""

    name: str
    """For a stage outside the run that was opened, with the run's name: `other:gpt`."""
    kind: str
    version: int
    fingerprint: str
    folder: Path
    config: Mapping[str, object]
    inputs: Mapping[str, StageRecord]
    """In the order of the recipe, then those of other runs."""
    outside: bool = False
    """In another run than the one that was opened, or in an export."""
    gone: Mapping[str, Path] = field(default_factory=dict)
    """Roles filled by stages of other runs that are not there any more, and where they were."""

    def upstream(self) -> Iterator[StageRecord]:
        """All stages above this one, some of them more than once."""
        for stage in self.inputs.values():
            yield stage
            yield from stage.upstream()


def not_here(export: Path, name: str) -> str:
    """Message on a stage that an export names and does not hold."""
    fix = "copy the whole folder, or export the run again"
    return f"{export / BUNDLE_FILE}: its stage '{name}' is not here; {fix}"


class RunReader:
    """Reads finished stages and those that fed them, each once, into other runs and exports too."""

    def __init__(self, home: Path | None) -> None:
        """`home` is the run or export whose stages have no run in their names; None where all of them do."""
        self._home = None if home is None else home.resolve()
        self._found: dict[Path, StageRecord | None] = {}
        self._places: dict[Path, dict[Path, int]] = {}

    def find(self, folder: Path) -> StageRecord | None:
        """The stage in a folder; None where it has not finished."""
        key = folder.resolve()  # one record for each stage, however it is reached
        if key not in self._found:
            self._found[key] = None  # a damaged folder may name itself
            self._found[key] = self._read(folder)
        return self._found[key]

    def _read(self, folder: Path) -> StageRecord | None:
        artifact = Artifact.find(folder)
        exported = in_export(folder)
        run = owner_of(folder)
        if artifact is None:
            return None
        inputs = dict[str, StageRecord]()
        gone = dict[str, Path]()
        for role, source in artifact.inputs.items():
            # An export may come from anywhere: nothing outside its folder is ever followed.
            stage = None if exported and source.folder is not None else self.find(source.place(folder))
            if stage is not None:
                inputs[role] = stage
            elif exported:
                raise UserError(not_here(run, source.stage))
            elif source.folder is not None:
                gone[role] = source.place(folder)
        outside = run.resolve() != self._home
        return StageRecord(
            name=label_of(folder) if outside else folder.name,
            kind=artifact.kind,
            version=artifact.version,
            fingerprint=artifact.fingerprint,
            folder=folder,
            config=artifact.config,
            inputs=inputs if exported else self._in_order(inputs, run),
            outside=outside,
            gone=gone,
        )

    def _in_order(self, inputs: Mapping[str, StageRecord], run: Path) -> dict[str, StageRecord]:
        """As the run's recipe has their stages, then others; an artifact lists them by role."""
        if run not in self._places:
            names = enumerate(stages_of(run))
            self._places[run] = {stage_folder(run, name).resolve(): number for number, name in names}
        own = self._places[run]
        return dict(sorted(inputs.items(), key=lambda item: own.get(item[1].folder.resolve(), len(own))))


def finished_records(run: Path) -> dict[str, StageRecord]:
    """The finished stages of a run by name, in the recipe's order."""
    reader = RunReader(run)
    records = {name: reader.find(stage_folder(run, name)) for name in stages_of(run)}
    return {name: stage for name, stage in records.items() if stage is not None}


@dataclass(frozen=True)
class StageState:
    """One stage of a run's recipe, and what there is of it."""

    name: str
    kind: str
    folder: Path
    settings: Mapping[str, object]
    """Settings that made a finished stage; else those of the recipe."""
    progress: Progress
    why: str = ""
    """Reason why a finished stage is outdated."""
    artifact: Artifact | None = None
    step: int | None = None
    """The last step of its training log."""
    steps: int | None = None
    """Steps in its settings."""
    seconds: float | None = None
    """Duration; for a training that was killed and resumed, of the last stretch."""
    hardware: str = ""
    """Machine that it ran on, where it was noted."""

    @property
    def usable(self) -> bool:
        """Finished, and of the stages that the run has now."""
        return self.progress == "finished"

    def say(self) -> str:
        if self.progress == "outdated":
            return f"outdated: {self.why}"
        if self.progress == "started":
            if self.steps is None or self.step is None:
                return "started, not finished"
            return f"in training, step {self.step:,} of {self.steps:,}"
        if self.artifact is not None and self.artifact.step is not None:
            return f"at step {self.artifact.step:,} of {self.steps:,}"
        return {"finished": "finished", "missing": "not run yet"}[self.progress]


@dataclass(frozen=True)
class RunState:
    """A run: its recipe, and how far each stage has come."""

    folder: Path
    recipe: str
    seed: int | None
    stages: tuple[StageState, ...]

    @property
    def unfinished(self) -> list[StageState]:
        return [stage for stage in self.stages if not stage.usable]


def run_state(run: Path) -> RunState:
    """Read a run folder; a `UserError` where it is none, or where a record in it cannot be read."""
    require_run(run)
    entries = stages_of(run)
    recipe = read_yaml(run / "recipe.yaml")
    seed = recipe.get("seed")
    changes: dict[Path, Changed | None] = {}
    return RunState(
        folder=run,
        recipe=str(recipe.get("name", run.name)),
        seed=seed if isinstance(seed, int) else None,
        stages=tuple(_stage(run, name, entry, changes) for name, entry in entries.items()),
    )


def _stage(
    run: Path, name: str, entry: Mapping[str, object], changes: dict[Path, Changed | None]
) -> StageState:
    from motionloom.pipeline.store.training_log import read_training_log

    folder = stage_folder(run, name)
    written = {key: value for key, value in entry.items() if key not in ("kind", "inputs")}
    artifact = Artifact.find(folder)
    settings = written if artifact is None else artifact.config
    why = "" if artifact is None else _why_outdated(run, name, changes)
    progress: Progress = "finished" if not why else "outdated"
    if artifact is None:
        progress = "started" if (folder / "started.json").is_file() else "missing"
    rows = read_training_log(folder)
    steps = _mapping(settings.get("train")).get("steps")
    timing = read_record(folder / "timing.json") if (folder / "timing.json").is_file() else {}
    seconds = timing.get("seconds")
    return StageState(
        name=name,
        kind=str(entry["kind"]) if artifact is None else artifact.kind,
        folder=folder,
        settings=settings,
        progress=progress,
        why=why,
        artifact=artifact,
        step=int(rows[-1]["step"]) if rows else (0 if progress == "started" and steps else None),
        steps=steps if isinstance(steps, int) else None,
        seconds=float(seconds) if artifact is not None and isinstance(seconds, int | float) else None,
        hardware=str(timing.get("hardware", "")) if artifact is not None else "",
    )


def _why_outdated(run: Path, name: str, visited: dict[Path, Changed | None]) -> str:
    """The first stage above a finished one that is another now than it was made from."""
    changed = changed_above(stage_folder(run, name), visited)
    if changed is None:
        return ""
    folder, source = changed
    own = folder.parent.parent
    where = f" of {own}" if source.folder is None and own.resolve() != run.resolve() else ""
    return f"{source.say(folder)}{where} has been made anew since"


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}
