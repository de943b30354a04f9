"""The recipes that come with the package; apart from `recipe.py`, which imports every stage."""

from __future__ import annotations

from importlib import resources
from pathlib import Path


def shipped_recipes() -> dict[str, Path]:
    """Recipes that come with the package, by name."""
    folder = Path(str(resources.files("motionloom.configs")))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}
