"""`artifact.json`: what a finished stage made, from what, with which config; written last of all.

It holds no times and no machine facts: an undisturbed run and one that was killed and resumed write the same
bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import Field

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.store.files import write_json

FILE_NAME = "artifact.json"

# What no result depends on: a stage's own notes, and settings that a later run may change.
_PRIVATE = {"checkpoints", "logs", "started.json", "timing.json", "reader.json", FILE_NAME}


class OutputFile(Config):
    """One file of an artifact."""

    bytes: int
    sha256: str


class InputStage(Config):
    """The stage that fed a role, and its fingerprint then."""

    stage: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
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
                outputs[name] = OutputFile(bytes=path.stat().st_size, sha256=sha256_of(path))
        done = self.model_copy(update={"outputs": outputs})
        write_json(folder / FILE_NAME, done.dump())
        return done


def require_consistent(run: Path, stages: Iterable[str]) -> None:
    """Refuse stages of a run that were made from something else than what their inputs hold now.

    Goes up to the first stage of all. What is gone without a trace cannot be compared and is let through.
    """
    todo, seen = list(stages), set[str]()
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        artifact = Artifact.find(run / "stages" / name)
        if artifact is None:
            continue
        for source in dict.fromkeys((i.stage, i.fingerprint) for i in artifact.inputs.values()):
            stage, fingerprint = source
            if fingerprint_now(run / "stages" / stage) not in (None, fingerprint):
                raise UserError(
                    f"{run}: stage '{name}' was made from another '{stage}', which has been made anew since; "
                    f"finish the run: motionloom run {run / 'recipe.yaml'} -o {run}"
                )
            todo.append(stage)


def fingerprint_now(folder: Path) -> str | None:
    """Of what a stage's folder holds, finished or not; None if nothing is there."""
    artifact = Artifact.find(folder)
    if artifact is not None:
        return artifact.fingerprint
    started = folder / "started.json"
    if not started.is_file():
        return None
    try:
        return str(json.loads(started.read_text(encoding="utf-8"))["fingerprint"])
    except (ValueError, KeyError, TypeError):
        raise UserError(
            f"{started}: not readable; delete the folder {folder} and run the recipe again"
        ) from None
