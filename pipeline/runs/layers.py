"""A recipe file over those that it extends, and `--set` over it: plain data, for which no kind is imported.

What it means is resolved afterwards (`resolve.py`). So a recipe that there is not, and a setting of none of
its stages, are refused before torch is imported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from motionloom.datasets.base.config import require_local
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.files import is_file
from motionloom.pipeline.store.run_folder import is_place
from motionloom.pipeline.store.yaml import load_yaml, merge, read_yaml

Tree = dict[str, Any]
"""Plain data of a recipe: what YAML and JSON know."""

START = "start"
"""Key of a recipe, and the role in which a stage takes the network that it goes on from."""

_DEEPEST = 4
_TOP = ("name", "description", "seed", "hardware", START, "defaults", "stages")


def shipped_recipes() -> dict[str, Path]:
    """Recipes that come with the package, by name: `FOLDER/SIZE.yaml` is called `FOLDER-SIZE`, `NAME.yaml` at
    the top `NAME`.
    """
    folder = Path(str(resources.files("motionloom.configs")))
    recipes = {f"{path.parent.name}-{path.stem}": path for path in folder.glob("*/*.yaml")}
    recipes |= {path.stem: path for path in folder.glob("*.yaml")}
    return dict(sorted(recipes.items()))


def find_recipe(name_or_path: str) -> Path:
    """A recipe file by path, or a shipped recipe by name; `FOLDER/SIZE` is a name too."""
    path = Path(name_or_path)
    require_local(path)
    if path.suffix in {".yaml", ".yml"}:
        if not is_file(path):
            raise UserError(f"{path}: no such recipe file")
        return path
    shipped = shipped_recipes()
    name = name_or_path.replace("/", "-")
    if name not in shipped:
        raise UserError(f"no recipe '{name_or_path}'{nearest(name, list(shipped))} (or give a .yaml file)")
    return shipped[name]


Hint = Callable[[Sequence[str], Mapping[str, Any]], str]
"""What may be meant by a setting, in parts, of no stage; "" where nothing is known."""


def layered(path: Path, overrides: Sequence[str], hint: Hint = lambda parts, stages: "") -> Tree:
    """A recipe with all that it extends and `--set` applied."""
    data = _read(path)
    for text in overrides:
        data = _override(data, text, hint)
    return data


def require_recipe(name_or_path: str, overrides: Sequence[str]) -> None:
    """Refuse a recipe that there is not, and settings of none of its stages."""
    # A setting that a training may have is answered with that training, which kinds know.
    known = [text for text in overrides if not re.match(r"\s*(optim\.|train\.)?[^.]*=", text)]
    layered(find_recipe(name_or_path), known)


# Files and what they extend.


def read_file(path: Path) -> Tree:
    """One recipe file alone; places in it are as seen from here."""
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise UserError(f"{path}: a recipe is a mapping with 'name' and 'stages'")
    if not isinstance(data.get("defaults") or {}, dict):
        raise UserError(f"{path}: defaults must map kinds of stages to settings")
    start = data.get(START)
    if isinstance(start, str) and (path.parent / Path(start).expanduser()).is_dir():
        data[START] = str(path.parent / Path(start).expanduser())
    if isinstance(data.get("stages"), dict):
        data["stages"] = {name: _placed(entry, path.parent) for name, entry in data["stages"].items()}
    return data


def _read(path: Path, depth: int = 0) -> Tree:
    """A recipe file over those that it extends."""
    data = read_file(path)
    base = data.pop("extends", None)
    if base is None:
        return data
    if depth > _DEEPEST:
        raise UserError(f"{path}: 'extends' goes in a circle or more than four files deep")
    # A file next to this one goes before a shipped recipe of the same name.
    beside = path.parent / (str(base) if str(base).endswith((".yaml", ".yml")) else f"{base}.yaml")
    extended = _read(beside if is_file(beside) else find_recipe(str(base)), depth + 1)
    old = extended.get("stages")
    new = data.get("stages")
    out = merge(extended, {key: value for key, value in data.items() if key != "stages"})
    if not isinstance(old, dict) or not isinstance(new, dict):
        return {**out, "stages": new if "stages" in data else old}
    stages = dict(old)
    for name, entry in new.items():
        before = old.get(name)
        if entry is None:
            _require_there(str(name), old, f"{path}: stages.{name} is null and")
            del stages[name]
        elif isinstance(before, dict) and isinstance(entry, dict):
            # Settings of one kind mean nothing to another.
            same = entry.get("kind", before.get("kind")) == before.get("kind")
            stages[name] = merge(before, entry) if same else entry
        else:
            stages[name] = entry
    return {**out, "stages": stages}


def _require_there(name: str, stages: Iterable[str], where: str) -> None:
    if name not in stages:
        raise UserError(f"{where} there is no such stage to remove{nearest(name, list(stages))}")


# `--set`.


def _override(data: Tree, text: str, hint: Hint) -> Tree:
    """The recipe with one `--set`: `stage.field=value`, `seed=8`, or `stage=null` to leave the stage out."""
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {text}: write it as stage.field=value")
    new = load_yaml(value, f"--set {text}")
    stages = data.get("stages") or {}
    if parts[0] not in _TOP:
        if parts[0] not in stages:
            meant = hint(parts, stages) or nearest(parts[0], [*stages, *_TOP], list(stages))
            raise UserError(f"--set {text}: no stage '{parts[0]}'{meant}")
        parts = ["stages", *parts]
    if parts[0] == "stages" and len(parts) == 2 and new is None:
        _require_there(parts[1], stages, f"--set {text}:")
        return {**data, "stages": {name: entry for name, entry in stages.items() if name != parts[1]}}
    # A value replaces what is there, a mapping too, but for settings of a whole stage.
    old = stages.get(parts[1]) if parts[0] == "stages" and len(parts) == 2 else None
    if isinstance(old, dict) and isinstance(new, dict) and "kind" not in new:
        new = merge(old, new)
    out: Tree = _put(data, parts, new)
    if parts[0] == "stages" and len(parts) > 1 and isinstance(out["stages"][parts[1]], dict):
        out["stages"][parts[1]] = _placed(out["stages"][parts[1]], None)
    return out


def _put(data: object, parts: Sequence[str], value: object) -> Any:
    if not parts:
        return value
    old = data if isinstance(data, dict) else {}
    return {**old, parts[0]: _put(old.get(parts[0]), parts[1:], value)}


# Stages of other runs, as `inputs` name them.


def place_name(folder: Path) -> str:
    """A stage outside the run as a loaded recipe names it: from the current folder if it is below it."""
    place = folder.resolve()
    here = Path.cwd()
    name = str(place.relative_to(here)) if place.is_relative_to(here) else str(place)
    return name if is_place(name) else f"./{name}"


def _placed(entry: Any, folder: Path | None) -> Any:
    """A stage's entry with its inputs' paths seen from here; `folder` is where the recipe is."""

    def seen(value: Any) -> Any:
        if isinstance(value, list):
            return [seen(one) for one in value]
        if not isinstance(value, str) or not is_place(value):
            return value
        written = Path(value).expanduser()
        # A path is seen from the recipe where it leads to something there, else from the current folder.
        if folder is not None and ((folder / written).exists() or value.startswith("../")):
            return place_name(folder / written)
        return place_name(written)

    if not isinstance(entry, dict) or not isinstance(entry.get("inputs"), dict):
        return entry
    return {**entry, "inputs": {role: seen(value) for role, value in entry["inputs"].items()}}
