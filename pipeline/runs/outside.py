"""Stages of other runs, and of exports, as inputs of a recipe: `inputs: {start: runs/other/stages/gpt}`.

A path is seen from the folder of the recipe file, else from the current one. The stage must be finished, of
the version that is installed, and made from what its own run holds now.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import outside_stage
from motionloom.pipeline.contract.stage import Finished, Stage
from motionloom.pipeline.runs.shipped import nearest
from motionloom.pipeline.store.artifact import Artifact, require_consistent
from motionloom.pipeline.store.outside import in_export, is_place, label_of, owner_of
from motionloom.pipeline.store.run_folder import stage_folder

_LIKE = "name the folder of a stage, like runs/other/stages/gpt"


def place_name(folder: Path) -> str:
    """A stage outside the run as a loaded recipe names it: from the current folder if it is below it."""
    place, here = folder.resolve(), Path.cwd()
    name = str(place.relative_to(here)) if place.is_relative_to(here) else str(place)
    return name if is_place(name) else f"./{name}"


def with_places(entry: Any, beside: Path | None) -> Any:
    """A stage's entry whose inputs name places in one way; `beside` is the folder of its recipe."""
    inputs = entry.get("inputs") if isinstance(entry, dict) else None
    if not isinstance(inputs, dict):
        return entry
    return {**entry, "inputs": {role: _placed(value, beside) for role, value in inputs.items()}}


def _placed(value: Any, beside: Path | None) -> Any:
    if isinstance(value, list):
        return [_placed(one, beside) for one in value]
    if not isinstance(value, str) or not is_place(value):
        return value
    written = Path(value).expanduser()
    if beside is not None and ((beside / written).exists() or value.startswith("../")):
        return place_name(beside / written)
    return place_name(written)


def find_outside(name: str, where: str) -> Finished:
    """A stage outside the run; a `UserError` says what is wrong with it and begins with `where`."""
    folder = Path(name).resolve()
    if not folder.is_dir():
        raise UserError(f"{where}: {name}: no such folder{_hint(folder)}")
    if (folder / "recipe.yaml").is_file() or (folder / "bundle.json").is_file():
        what = "a whole run" if (folder / "recipe.yaml").is_file() else "a whole export"
        raise UserError(f"{where}: {name}: {what}; name one of its stages{_hint(_first(folder))}")
    found = outside_stage(folder)
    if found is None:
        known = (folder / "started.json").is_file()
        fix = "; finish its run first" if known else f"; {_LIKE}"
        raise UserError(f"{where}: {name}: no finished stage (no artifact.json){fix}")
    if not in_export(folder):
        _require_usable(found, name, where)
    return found


def _require_usable(found: Finished, name: str, where: str) -> None:
    run = owner_of(found.folder)
    again = f"make it anew: motionloom run {run / 'recipe.yaml'} -o {run}"
    for stage in _needed(found):
        artifact = Artifact.find(stage.folder)
        if artifact is None:  # in an export, which is checked as it is opened
            continue
        if artifact.version != stage.kind.version:
            raise UserError(
                f"{where}: {name}: '{stage.folder.name}' was made by version {artifact.version} of stage "
                f"kind {artifact.kind}, which is now version {stage.kind.version}; {again}"
            )
        if gone := artifact.missing(stage.folder):
            raise UserError(f"{where}: {name}: {stage.folder / gone} is gone or has another size; {again}")
    try:
        require_consistent(run, [found.folder.name])
    except UserError as error:
        raise UserError(f"{where}: {name}: {error}") from None


def _needed(stage: Finished) -> Iterable[Finished]:
    """A stage and those that it needs to load."""
    yield stage
    for role in stage.kind.exported(stage.config):
        if role in stage.inputs:
            yield from _needed(stage.inputs[role])


def _first(folder: Path) -> Path:
    """Where the stages of a run or an export lie."""
    return folder / "stages" / "" if (folder / "recipe.yaml").is_file() else folder / ""


def _hint(folder: Path) -> str:
    """Stages beside a folder that is no stage's."""
    parent = folder.parent if not folder.is_dir() else folder
    there = [one.name for one in sorted(parent.iterdir()) if one.is_dir()] if parent.is_dir() else []
    names = [name for name in there if not name.startswith(".")]
    return nearest(folder.name, names) if names else f"; {_LIKE}"


def as_stages(found: Mapping[str, Finished]) -> dict[str, Stage]:
    """Outside stages and all above them, as the checks of a recipe see stages."""
    out: dict[str, Stage] = {}
    for name, stage in found.items():
        _add(name, stage, out)
    return out


def _add(name: str, stage: Finished, out: dict[str, Stage]) -> None:
    if name in out:
        return
    above = {role: (place_name(source.folder), source) for role, source in stage.inputs.items()}
    out[name] = Stage(name, stage.kind, stage.config, {role: place for role, (place, _) in above.items()})
    for place, source in above.values():
        _add(place, source, out)


def require_elsewhere(run: Path, stage: Stage, found: Mapping[str, Finished]) -> None:
    """Refuse, as an input from outside, a stage of the run itself, or one made from what it shall feed."""
    target = stage_folder(run, stage.name).resolve()
    for name in stage.inputs.values():
        if name not in found:
            continue
        source = found[name]
        if owner_of(source.folder).resolve() == run.resolve():
            raise UserError(
                f"stage '{stage.name}': {name} is a stage of this very run; name it '{source.folder.name}'"
            )
        if any(above.folder.resolve() == target for above in source.upstream()):
            raise UserError(
                f"stage '{stage.name}': {label_of(source.folder)} was itself made from this stage of {run}; "
                f"choose another folder with -o"
            )
