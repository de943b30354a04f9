"""Where a run keeps what, read without running anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.base.places import no_such_folder
from motionloom.datasets.schema import UserError
from motionloom.pipeline.store.yaml import read_yaml


def stage_folder(run: Path, name: str) -> Path:
    """Where a stage keeps its files."""
    return run / "stages" / name


def stages_of(run: Path) -> dict[str, dict[str, Any]]:
    """The stages of a run's resolved recipe, as they are written there."""
    require_run(run)
    path = run / "recipe.yaml"
    recipe = read_yaml(path)
    stages = recipe.get("stages") if isinstance(recipe, dict) else None
    if not isinstance(stages, dict) or not all(isinstance(e, dict) and "kind" in e for e in stages.values()):
        raise UserError(f"{path}: holds no stages; run the recipe again into this folder")
    return stages


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
