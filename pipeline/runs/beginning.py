"""The folder of a stage that is about to run: empty, with a checkpoint, or as a killed run left it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.pipeline.store.files import link_or_copy, remove_tree, write_json


def prepare_folder(folder: Path, started: dict[str, Any], *, anew: bool, start: Path | None) -> None:
    """Make a stage's folder and mark it with what is being made in it.

    `anew` empties it; `start` is a checkpoint that it then begins with, which may lie in the folder itself.
    """
    if anew:
        aside = aside_of(folder)
        if start is not None and start.parent != aside:
            remove_tree(aside)
            link_or_copy(start, aside / start.name)
        remove_tree(folder)
        if start is not None:
            place = folder / "checkpoints"
            place.mkdir(parents=True)
            (aside / start.name).rename(place / start.name)
            remove_tree(aside)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "started.json", started)
    # A training that is made longer is not finished any more.
    (folder / "artifact.json").unlink(missing_ok=True)


def aside_of(folder: Path) -> Path:
    """Where the checkpoint lies while the stage's folder is emptied; a kill then leaves it there."""
    return folder.with_name(f".{folder.name}.branch")
