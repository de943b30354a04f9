"""Where a run keeps what, read without running anything, and the stages outside it that feed its own.

A recipe names a stage of another run, or of an export, by its path; a path has a slash and a stage's name has
none. Records of a run say the path from the run's folder, so that runs which are moved together still find
each other. What such a stage holds is described by its *identity*: a digest of its settings and of the
checksums of its outputs, since a training that is forced to run again has the same fingerprint and other
weights.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.places import no_such_folder
from motionloom.pipeline.store.files import fingerprint_of, read_record
from motionloom.pipeline.store.yaml import read_yaml

BUNDLE_FILE = "bundle.json"
"""At the top of an export."""

STAGE_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,99}$"
"""A stage's name is that of its folder."""

UNFINISHED = "unfinished"
"""The identity of a stage that has been begun and is not finished."""


def is_place(name: str) -> bool:
    """Whether an entry of a recipe's `inputs` is a path rather than a stage's name."""
    return "/" in name or os.sep in name


def in_export(stage: Path) -> bool:
    """Whether a stage's folder is in an export."""
    return (stage.parent / BUNDLE_FILE).is_file()


def owner_of(stage: Path) -> Path:
    """The run or the export that contains a stage's folder."""
    return stage.parent if in_export(stage) else stage.parent.parent


def label_of(stage: Path) -> str:
    """Label of a stage outside the run, `other:gpt`; no stage of a run has such a name."""
    place = stage.resolve()
    return f"{owner_of(place).name}:{place.name}"


def place_from(run: Path, stage: Path) -> str:
    """The path of a stage's folder, seen from a run's."""
    return Path(os.path.relpath(stage.resolve(), run.resolve())).as_posix()


def identity_of(stage: Path) -> str | None:
    """Tells what a stage's folder holds from all else it might hold; None where nothing is there."""
    artifact = stage / "artifact.json"
    if not artifact.is_file():
        return UNFINISHED if (stage / "started.json").is_file() else None
    record = read_record(artifact)
    outputs = record.get("outputs")
    files = {name: file.get("sha256") for name, file in outputs.items()} if isinstance(outputs, dict) else {}
    return fingerprint_of({"fingerprint": record.get("fingerprint"), "files": files})


def stage_folder(run: Path, name: str) -> Path:
    """Where a stage keeps its files."""
    return run / "stages" / name


def stages_of(run: Path) -> dict[str, dict[str, Any]]:
    """The stages of a run's resolved recipe, as they are written there."""
    require_run(run)
    path = run / "recipe.yaml"
    recipe = read_yaml(path)
    stages = recipe.get("stages") if isinstance(recipe, dict) else None
    stages = stages if isinstance(stages, dict) else {"": None}
    if not all(
        re.fullmatch(STAGE_NAME, n) and isinstance(e, dict) and "kind" in e for n, e in stages.items()
    ):
        raise UserError(f"{path}: holds no stages; run the recipe again into this folder")
    return stages


def hint_at(run: Path) -> str:
    """The end of a message on what is not finished in a run: how to use a training as far as it is."""
    begun = (path.parents[1] / "artifact.json" for path in run.glob("stages/*/checkpoints/*.ckpt"))
    return "" if all(map(Path.is_file, begun)) else ", or take a training as far as it is: --at newest"


def require_own(run: Path) -> None:
    """Refuse a run folder in which a link leads out of it: what is written there would land elsewhere.

    Only plain files and folders are in a run. One that does not exist yet is no matter.
    """
    home = run.resolve()
    todo = [run]
    while todo:
        folder = todo.pop()
        for entry in os.scandir(folder) if folder.is_dir() else ():
            if entry.is_symlink():
                if not Path(entry.path).resolve().is_relative_to(home):
                    raise UserError(
                        f"{entry.path}: is a link out of its run folder; put what it names in its place"
                    )
            elif entry.is_dir():
                todo.append(Path(entry.path))
            elif not entry.is_file():
                raise UserError(f"{entry.path}: is neither a file nor a folder; remove it")


def require_run(folder: Path) -> None:
    """Refuse what is no run folder, and say what it is instead."""
    if (folder / "recipe.yaml").is_file():
        return
    if (folder / "bundle.json").is_file():
        raise UserError(
            f"{folder}: an exported folder, which generates and holds nothing else; name the run folder "
            f"(runs/NAME) that it was made from"
        )
    if not folder.exists():
        raise UserError(no_such_folder(folder))
    raise UserError(f"{folder}: not a run folder (no recipe.yaml)")
