"""The finished stages of a run as their records say, without loading one: no torch is imported here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.outside import BUNDLE_FILE, identity_of, in_export, label_of, owner_of
from motionloom.pipeline.store.run_folder import stage_folder, stages_of
from motionloom.pipeline.store.run_state import read_record


@dataclass(frozen=True)
class RunStage:
    """A finished stage: kind, config with every default, and the stages that fed it, by role."""

    name: str
    kind: str
    version: int
    fingerprint: str
    config: Mapping[str, Any]
    inputs: Mapping[str, RunStage]

    def upstream(self) -> Iterator[RunStage]:
        """All stages above this one, some of them more than once."""
        for stage in self.inputs.values():
            yield stage
            yield from stage.upstream()

    @property
    def of_faces(self) -> bool:
        """Whether it models the face alone."""
        return self.config.get("face") is True or self.config.get("part") == "face"


def run_stages(run: Path) -> dict[str, RunStage]:
    """The finished stages of a run by name, in the recipe's order; inputs as the recipe orders them.

    Stages of other runs stand only among the inputs, under the name of both: `other:gpt`.
    """
    names, home = list(stages_of(run)), run.resolve()
    place = {name: number for number, name in enumerate(names)}
    found: dict[Path, RunStage | None] = {}

    def find(folder: Path) -> RunStage | None:
        key = folder.resolve()
        if key not in found:
            found[key] = None  # a record that names itself is no reason to search for ever
            owner = owner_of(folder)
            artifact = _record(folder)
            if artifact is not None:
                inputs = {role: find(source.place(owner)) for role, source in artifact.inputs.items()}
                known = {role: stage for role, stage in inputs.items() if stage is not None}
                ordered = dict(sorted(known.items(), key=lambda item: place.get(item[1].name, len(place))))
                found[key] = RunStage(
                    folder.name if owner.resolve() == home else label_of(folder),
                    artifact.kind,
                    artifact.version,
                    artifact.fingerprint,
                    artifact.config,
                    ordered,
                )
        return found[key]

    stages = {name: find(stage_folder(run, name)) for name in names}
    return {name: stage for name, stage in stages.items() if stage is not None}


def _record(folder: Path) -> Artifact | None:
    """What made a stage; of an export's, as far as the export says it."""
    if not in_export(folder):
        return Artifact.find(folder)
    entries = read_record(folder.parent / BUNDLE_FILE).get("stages")
    entry = entries.get(folder.name) if isinstance(entries, dict) else None
    if not isinstance(entry, dict):
        return None
    where, identity = folder.parent / BUNDLE_FILE, str(identity_of(folder))
    inputs = {
        role: {"stage": name, "fingerprint": "", "folder": str(folder.parent.resolve() / str(name))}
        for role, name in dict(entry.get("inputs", {})).items()
    }
    data = {**entry, "stage": folder.name, "fingerprint": identity, "seed": 0, "inputs": inputs}
    return Artifact.parse(data, f"{where}: stages.{folder.name}")
