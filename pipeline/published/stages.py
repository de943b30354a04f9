"""The finished stages of a run as their records say, without loading one: no torch is imported here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.run_folder import stage_folder, stages_of


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
    """The finished stages of a run by name, in the recipe's order; inputs as the recipe orders them."""
    names = list(stages_of(run))
    place = {name: number for number, name in enumerate(names)}
    found: dict[str, RunStage | None] = {}

    def find(name: str) -> RunStage | None:
        if name not in found:
            found[name] = None  # a record that names itself is no reason to search for ever
            artifact = Artifact.find(stage_folder(run, name))
            if artifact is not None:
                inputs = {role: find(source.stage) for role, source in artifact.inputs.items()}
                known = {role: stage for role, stage in inputs.items() if stage is not None}
                ordered = dict(sorted(known.items(), key=lambda item: place.get(item[1].name, len(place))))
                found[name] = RunStage(
                    name, artifact.kind, artifact.version, artifact.fingerprint, artifact.config, ordered
                )
        return found[name]

    stages = {name: find(name) for name in names}
    return {name: stage for name, stage in stages.items() if stage is not None}
