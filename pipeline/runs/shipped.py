"""The recipes that come with the package, and recipes by name; apart from `recipe.py`, which imports every
stage.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from motionloom.datasets.schema import UserError


def shipped_recipes() -> dict[str, Path]:
    """Recipes that come with the package, by name: `FOLDER/SIZE.yaml` is called `FOLDER-SIZE`, `NAME.yaml` at
    the top `NAME`.
    """
    folder = Path(str(resources.files("motionloom.configs")))
    found = {f"{path.parent.name}-{path.stem}": path for path in folder.glob("*/*.yaml")}
    found |= {path.stem: path for path in folder.glob("*.yaml")}
    return dict(sorted(found.items()))


def find_recipe(name_or_path: str) -> Path:
    """A recipe file by path, or a shipped recipe by name; `FOLDER/SIZE` is a name too."""
    path = Path(name_or_path)
    if path.suffix in {".yaml", ".yml"}:
        if not path.is_file():
            raise UserError(f"{path}: no such recipe file")
        return path
    shipped, name = shipped_recipes(), name_or_path.replace("/", "-")
    if name not in shipped:
        raise UserError(f"no recipe '{name_or_path}'{nearest(name, list(shipped))} (or give a .yaml file)")
    return shipped[name]


def nearest(name: str, valid: Sequence[str], shown: Sequence[str] | None = None) -> str:
    """A hint to append: did you mean 'x'?, or the list of valid names, or else of those `shown`."""
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    names = valid if shown is None else shown
    return f"; did you mean '{near[0]}'?" if near else f"; valid names: {', '.join(names)}"
