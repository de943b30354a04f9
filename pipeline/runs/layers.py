"""The layers of a recipe as plain data: the recipes that it extends, itself, and `--set` over all.

Mappings merge key by key, the later layer's values win, and lists are replaced whole. Two things hold for
stages alone: one of another kind has other fields, so it replaces the old one whole, and `null` removes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.runs.outside import with_places
from motionloom.pipeline.runs.shipped import find_recipe, nearest
from motionloom.pipeline.store.yaml import load_yaml, read_yaml

_DEEPEST = 4
_TOP = ("name", "description", "seed", "data_seed", "hardware", "start", "defaults", "stages")


@dataclass(frozen=True)
class Layers:
    """A recipe as plain data, and the stages that one of its layers has left out."""

    data: dict[str, Any]
    removed: dict[str, str] = field(default_factory=dict)
    """Name -> the file or option that says `null`."""


def read_layers(path: Path, depth: int = 0) -> Layers:
    """A recipe file merged into what it extends."""
    data = read_recipe_file(path)
    base = data.pop("extends", None)
    if base is None:
        return Layers(data)
    if depth > _DEEPEST:
        raise UserError(f"{path}: 'extends' goes in a circle or more than four files deep")
    return _extend(read_layers(_base(path, str(base)), depth + 1), data, path)


def read_recipe_file(path: Path) -> dict[str, Any]:
    """One recipe file alone."""
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise UserError(f"{path}: a recipe is a mapping with 'name' and 'stages'")
    stages = data.get("stages")
    if "start" in data:
        data["start"] = _start_place(data["start"], path.parent)
    if isinstance(stages, dict):
        data["stages"] = {name: with_places(entry, path.parent) for name, entry in stages.items()}
    return data


def _start_place(name: Any, folder: Path) -> Any:
    """A `start` as it is seen from the folder of the recipe file, where there is one, else as it stands."""
    there = isinstance(name, str) and (folder / Path(name).expanduser()).is_dir()
    return str(folder / Path(name).expanduser()) if there else name


def _base(path: Path, base: str) -> Path:
    """The recipe that `path` extends: a file beside it, else a shipped recipe."""
    beside = path.parent / (base if base.endswith((".yaml", ".yml")) else f"{base}.yaml")
    return beside if beside.is_file() else find_recipe(base)


def _extend(base: Layers, change: dict[str, Any], path: Path) -> Layers:
    out = merge(base.data, {key: value for key, value in change.items() if key != "stages"})
    if "stages" not in change:
        return Layers(out, base.removed)
    old, new = base.data.get("stages"), change["stages"]
    if not isinstance(old, dict) or not isinstance(new, dict):
        return Layers({**out, "stages": new}, base.removed)
    removed = {name: said for name, said in base.removed.items() if name not in new}
    removed |= {str(name): f"stages.{name}: null in {path}" for name, entry in new.items() if entry is None}
    return Layers({**out, "stages": _extend_stages(old, new, path)}, removed)


def _extend_stages(base: dict[str, Any], change: dict[str, Any], path: Path) -> dict[str, Any]:
    out = dict(base)
    for name, entry in change.items():
        old = base.get(name)
        if entry is None:
            _require_there(str(name), base, f"{path}: stages.{name} is null and")
            del out[name]
        elif isinstance(old, dict) and isinstance(entry, dict):
            same_kind = entry.get("kind", old.get("kind")) == old.get("kind")
            out[name] = merge(old, entry) if same_kind else entry
        else:
            out[name] = entry
    return out


def _require_there(name: str, stages: dict[str, Any], where: str) -> None:
    if name not in stages:
        raise UserError(f"{where} there is no such stage to remove{nearest(name, list(stages))}")


def merge(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """`change` over `base`, mappings key by key; neither is altered."""
    out = dict(base)
    for key, value in change.items():
        old = out.get(key)
        out[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def override(layers: Layers, text: str) -> Layers:
    """The recipe with one `--set`: `stage.field=value`, `seed=8`, or `stage=null`, which leaves it out."""
    data, (key, equals, value) = layers.data, text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {text}: write it as stage.field=value")
    new, stages = load_yaml(value, f"--set {text}"), data.get("stages") or {}
    if parts[0] not in _TOP:
        if parts[0] not in stages:
            hint = nearest(parts[0], [*stages, *_TOP], list(stages))
            by = layers.removed.get(parts[0])
            raise UserError(f"--set {text}: no stage '{parts[0]}'{hint if by is None else f'; {by}'}")
        parts = ["stages", *parts]
    if parts[0] == "stages" and len(parts) == 2 and new is None:
        _require_there(parts[1], stages, f"--set {text}:")
        rest = {name: entry for name, entry in stages.items() if name != parts[1]}
        return Layers({**data, "stages": rest}, {**layers.removed, parts[1]: f"--set {text}"})
    # A value replaces what is there, a mapping too.
    out: dict[str, Any] = _put(data, parts, new)
    if parts[0] == "stages" and len(parts) > 2 and isinstance(out["stages"][parts[1]], dict):
        out["stages"][parts[1]] = with_places(out["stages"][parts[1]], None)
    return Layers(out, layers.removed)


def _put(data: Any, parts: list[str], value: Any) -> Any:
    if not parts:
        return value
    old = data if isinstance(data, dict) else {}
    return {**old, parts[0]: _put(old.get(parts[0]), parts[1:], value)}
