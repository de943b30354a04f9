"""Stages outside a run: the folder of a stage of another run, or of an export, as an input of a run's stage.

A recipe names one by its path; a path has a slash and a stage's name has none. Records of a run say the path
from the run's folder, so that runs which are moved together still find each other. What such a stage holds is
told by its *identity*: of its settings and of the checksums of all it has made, since a training that is
forced to run again has the same fingerprint and other weights.
"""

from __future__ import annotations

import json
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.store.files import fingerprint_of

BUNDLE_FILE = "bundle.json"
"""At the top of an export."""

UNFINISHED = "unfinished"
"""The identity of a stage that has been begun and is not finished."""


def is_place(name: str) -> bool:
    """Whether what stands in a recipe's `inputs` is a path and no stage's name."""
    return "/" in name or os.sep in name


def in_export(stage: Path) -> bool:
    """Whether a stage's folder lies in an export."""
    return (stage.parent / BUNDLE_FILE).is_file()


def owner_of(stage: Path) -> Path:
    """The run or the export that a stage's folder lies in."""
    return stage.parent if in_export(stage) else stage.parent.parent


def label_of(stage: Path) -> str:
    """What people call a stage outside their run: `other:gpt`. No stage of a run is called so."""
    place = stage.resolve()
    return f"{owner_of(place).name}:{place.name}"


def place_from(run: Path, stage: Path) -> str:
    """The path of a stage's folder, seen from a run's."""
    return Path(os.path.relpath(stage.resolve(), run.resolve())).as_posix()


def identity_of(stage: Path) -> str | None:
    """Tells what a stage's folder holds from all else it might hold; None where nothing is there."""
    if in_export(stage):
        return _exported_identity(stage)
    artifact = stage / "artifact.json"
    if not artifact.is_file():
        return UNFINISHED if (stage / "started.json").is_file() else None
    record = _record(artifact)
    outputs = record.get("outputs")
    files = {name: file.get("sha256") for name, file in outputs.items()} if isinstance(outputs, dict) else {}
    return fingerprint_of({"fingerprint": record.get("fingerprint"), "files": files})


def _exported_identity(stage: Path, above: tuple[str, ...] = ()) -> str | None:
    """An export has no list of checksums, so its files are read; only those inside it."""
    bundle = stage.parent / BUNDLE_FILE
    entries = _record(bundle).get("stages")
    entry = entries.get(stage.name) if isinstance(entries, dict) else None
    if not isinstance(entry, dict) or not stage.is_dir():
        return None
    if stage.name in above:
        raise UserError(f"{bundle}: stage '{stage.name}' needs itself; export the run again")
    inputs = entry.get("inputs")
    names = {role: Path(str(name)).name for role, name in inputs.items()} if isinstance(inputs, dict) else {}
    over = (*above, stage.name)
    facts = {
        "stage": {key: value for key, value in entry.items() if key != "inputs"},
        "inputs": {role: _exported_identity(stage.parent / name, over) for role, name in names.items()},
        "files": {path.relative_to(stage).as_posix(): _digest(path) for path in sorted(stage.rglob("*"))},
    }
    return fingerprint_of(facts)


def _digest(path: Path) -> str | None:
    if not path.is_file():
        return None
    state = path.stat()
    return _digest_of(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=256)
def _digest_of(path: Path, size: int, changed: int) -> str:
    """Of a file as it is now, read once while it stays so."""
    return sha256_of(path)


def _record(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({error}); make its run or export again") from None
    return data if isinstance(data, dict) else {}
