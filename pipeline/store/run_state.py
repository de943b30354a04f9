"""How far a run has come, from its files alone: no stage is loaded, and torch is not imported."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from motionloom.datasets.schema import UserError
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.outside import in_export
from motionloom.pipeline.store.run_folder import require_run, stage_folder, stages_of
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.store.yaml import read_yaml

Progress = Literal["finished", "outdated", "started", "missing"]


@dataclass(frozen=True)
class StageState:
    """One stage of a run's recipe, and what there is of it."""

    name: str
    kind: str
    folder: Path
    settings: Mapping[str, Any]
    """What made it, of a finished stage; else what its recipe says."""
    progress: Progress
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """Roles that its recipe fills otherwise than by their names."""
    why: str = ""
    """What makes a finished stage outdated."""
    artifact: Artifact | None = None
    step: int | None = None
    """The last step of its training log."""
    steps: int | None = None
    """Those that its settings ask for."""
    seconds: float | None = None
    """How long it took; of a training that was killed and went on, the last stretch."""
    hardware: str = ""
    """What it ran on, where it was noted."""

    @property
    def usable(self) -> bool:
        """Finished, and of the stages that the run has now."""
        return self.progress == "finished"

    def say(self) -> str:
        """Its progress, for people."""
        if self.progress == "outdated":
            return f"outdated: {self.why}"
        if self.progress == "started":
            if self.steps is None or self.step is None:
                return "started, not finished"
            return f"in training, step {self.step:,} of {self.steps:,}"
        return {"finished": "finished", "missing": "not run yet"}[self.progress]


@dataclass(frozen=True)
class RunState:
    """A run: its recipe, and how far each stage has come."""

    folder: Path
    recipe: str
    seed: int | None
    data_seed: int | None
    hardware: Mapping[str, Any]
    stages: tuple[StageState, ...]

    def stage(self, name: str) -> StageState | None:
        """A stage by name, None where the recipe has none."""
        return next((stage for stage in self.stages if stage.name == name), None)

    @property
    def unfinished(self) -> list[StageState]:
        """Stages that there is something missing of."""
        return [stage for stage in self.stages if not stage.usable]

    def say_unfinished(self) -> str:
        """What is missing, in words; nothing where all is there."""
        return "; ".join(f"{stage.name} ({stage.say()})" for stage in self.unfinished)


def run_state(run: Path) -> RunState:
    """Read a run folder; a `UserError` where it is none, or where a record in it cannot be read."""
    require_run(run)
    entries = stages_of(run)
    recipe = read_yaml(run / "recipe.yaml")
    seed, data_seed = recipe.get("seed"), recipe.get("data_seed")
    causes: dict[str, str] = {}
    return RunState(
        folder=run,
        recipe=str(recipe.get("name", run.name)),
        seed=seed if isinstance(seed, int) else None,
        data_seed=data_seed if isinstance(data_seed, int) else None,
        hardware=_mapping(recipe.get("hardware")),
        stages=tuple(_stage(run, name, entry, causes) for name, entry in entries.items()),
    )


def read_record(path: Path) -> dict[str, Any]:
    """A JSON object that a run keeps; a `UserError` names the file."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); run its stage again") from None
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({error}); run its stage again") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: holds no JSON object; run its stage again")
    return data


def _stage(run: Path, name: str, entry: Mapping[str, Any], causes: dict[str, str]) -> StageState:
    folder = stage_folder(run, name)
    written = {key: value for key, value in entry.items() if key not in ("kind", "inputs")}
    artifact = Artifact.find(folder)
    settings = written if artifact is None else artifact.config
    why = "" if artifact is None else _why_outdated(run, name, causes)
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
        inputs=_mapping(entry.get("inputs")),
        why=why,
        artifact=artifact,
        step=int(rows[-1]["step"]) if rows else (0 if progress == "started" and steps else None),
        steps=steps if isinstance(steps, int) else None,
        seconds=float(seconds) if artifact is not None and isinstance(seconds, int | float) else None,
        hardware=str(timing.get("hardware", "")) if artifact is not None else "",
    )


def _why_outdated(run: Path, name: str, causes: dict[str, str]) -> str:
    """The first stage above a finished one that is another now than it was made from."""
    return _cause(stage_folder(run, name), run.resolve(), causes)


def _cause(folder: Path, home: Path, causes: dict[str, str]) -> str:
    key = str(folder.resolve())
    if key not in causes:
        causes[key] = ""  # a damaged folder may name itself
        artifact = None if in_export(folder) else Artifact.find(folder)
        own = folder.parent.parent
        for source in () if artifact is None else artifact.inputs.values():
            if source.now(own) not in (None, source.fingerprint):
                there = "" if own.resolve() == home else f" of {own}"
                causes[key] = (
                    f"{source.say(own)}{there if source.folder is None else ''} has been made anew since"
                )
            elif cause := _cause(source.place(own), home, causes):
                causes[key] = cause
            if causes[key]:
                break
    return causes[key]


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
