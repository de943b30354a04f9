"""The layers of a recipe as plain data: the recipes that it extends, itself, and `--set` over all.

Mappings merge key by key, the later layer's values win, and lists are replaced whole. Two things hold for
stages alone: one of another kind has other fields, so it replaces the old one whole, and `null` removes it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.runs.shipped import find_recipe, nearest
from motionloom.pipeline.store.yaml import load_yaml, read_yaml

_DEEPEST = 4
_TOP = ("name", "description", "seed", "hardware", "defaults", "stages")


def read_layers(path: Path, depth: int = 0) -> dict[str, Any]:
    """A recipe file merged into what it extends."""
    data = read_recipe_file(path)
    base = data.pop("extends", None)
    if base is None:
        return data
    if depth > _DEEPEST:
        raise UserError(f"{path}: 'extends' goes in a circle or more than four files deep")
    return _extend(read_layers(_base(path, str(base)), depth + 1), data, path)


def read_recipe_file(path: Path) -> dict[str, Any]:
    """One recipe file alone."""
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise UserError(f"{path}: a recipe is a mapping with 'name' and 'stages'")
    return data


def _base(path: Path, base: str) -> Path:
    """The recipe that `path` extends: a file beside it, else a shipped recipe."""
    beside = path.parent / (base if base.endswith((".yaml", ".yml")) else f"{base}.yaml")
    return beside if beside.is_file() else find_recipe(base)


def _extend(base: dict[str, Any], change: dict[str, Any], path: Path) -> dict[str, Any]:
    out = merge(base, {key: value for key, value in change.items() if key != "stages"})
    if "stages" not in change:
        return out
    old, new = base.get("stages"), change["stages"]
    out["stages"] = _extend_stages(old, new, path) if isinstance(old, dict) and isinstance(new, dict) else new
    return out


def _extend_stages(base: dict[str, Any], change: dict[str, Any], path: Path) -> dict[str, Any]:
    out = dict(base)
    for name, entry in change.items():
        old = base.get(name)
        if entry is None:
            if name not in base:
                hint = nearest(str(name), list(base))
                raise UserError(f"{path}: stages.{name} is null and there is no such stage to remove{hint}")
            del out[name]
        elif isinstance(old, dict) and isinstance(entry, dict):
            same_kind = entry.get("kind", old.get("kind")) == old.get("kind")
            out[name] = merge(old, entry) if same_kind else entry
        else:
            out[name] = entry
    return out


def merge(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """`change` over `base`, mappings key by key; neither is altered."""
    out = dict(base)
    for key, value in change.items():
        old = out.get(key)
        out[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def override(data: dict[str, Any], text: str) -> dict[str, Any]:
    """The recipe with one `--set`: `stage.field=value`, or `seed=8`."""
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {text}: write it as stage.field=value")
    if parts[0] not in _TOP:
        stages = data.get("stages") or {}
        if parts[0] not in stages:
            raise UserError(f"--set {text}: no stage '{parts[0]}'{nearest(parts[0], list(stages))}")
        parts = ["stages", *parts]
    # A value replaces what is there, a mapping too.
    out: dict[str, Any] = _put(data, parts, load_yaml(value, f"--set {text}"))
    return out


def _put(data: Any, parts: list[str], value: Any) -> Any:
    if not parts:
        return value
    old = data if isinstance(data, dict) else {}
    return {**old, parts[0]: _put(old.get(parts[0]), parts[1:], value)}
