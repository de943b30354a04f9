"""`artifact.json`: what a finished stage made, from what, with which config; written last of all.

It holds no times and no machine facts: an undisturbed run and one that was killed and resumed write the same
bytes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from motionloom.datasets.schema import Config
from motionloom.pipeline.files import sha256_file, write_json

FILE_NAME = "artifact.json"

# What no result depends on: a stage's own notes, and settings that a later run may change.
_PRIVATE = {"checkpoints", "started.json", "timing.json", "reader.json", FILE_NAME}


class OutputFile(Config):
    """One file of an artifact."""

    bytes: int
    sha256: str


class InputStage(Config):
    """The stage that fed a role, and its fingerprint then."""

    stage: str
    fingerprint: str


class Artifact(Config):
    """The record of a finished stage."""

    stage: str
    kind: str
    version: int
    fingerprint: str
    seed: int
    config: dict[str, Any]
    inputs: dict[str, InputStage]
    outputs: dict[str, OutputFile] = Field(default_factory=dict)

    @staticmethod
    def find(folder: Path) -> Artifact | None:
        """The artifact in a stage folder, or None when the stage has not finished."""
        path = folder / FILE_NAME
        return Artifact.load_json(path) if path.is_file() else None

    def missing(self, folder: Path) -> str | None:
        """First output that is gone or has another size."""
        for name, info in self.outputs.items():
            path = folder / name
            if not path.is_file() or path.stat().st_size != info.bytes:
                return name
        return None

    def finish(self, folder: Path) -> Artifact:
        """Hash every output and write `artifact.json`."""
        outputs = {}
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            name = path.relative_to(folder).as_posix()
            if name.split("/")[0] not in _PRIVATE and not path.name.startswith("."):
                outputs[name] = OutputFile(bytes=path.stat().st_size, sha256=sha256_file(path))
        done = self.model_copy(update={"outputs": outputs})
        write_json(folder / FILE_NAME, done.dump())
        return done
