"""The trained models that come with the package, and which folder a model's name means.

Each is an exported folder in `models/pretrained/` with its card (`README.md`), known by the folder's name:
`motionloom generate synthetic "a person waves"`. A folder of that name in the current directory goes first.
"""

from __future__ import annotations

import difflib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from motionloom.datasets.base.places import no_such_folder
from motionloom.pipeline.store.run_folder import BUNDLE_FILE

CARD_FIGURES = "card.json"
"""Beside a model's card: its figures, and what it is in one line."""


@dataclass(frozen=True)
class ShippedModel:
    """A model that comes with the package."""

    name: str
    folder: Path

    @property
    def bytes(self) -> int:
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())

    @property
    def description(self) -> str:
        """The model in one line; empty where its card does not say."""
        try:
            facts = json.loads((self.folder / CARD_FIGURES).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return ""
        return str(facts.get("description", "")) if isinstance(facts, dict) else ""


def shipped_models() -> dict[str, ShippedModel]:
    """The models that come with this installation, by name; none where it was made without their weights."""
    return {
        file.parent.name: ShippedModel(file.parent.name, file.parent)
        for file in sorted(_place().glob(f"*/{BUNDLE_FILE}"))
    }


def model_folder(name: Path | str) -> Path:
    """The folder that a name means: one that is there, else a model that comes with the package."""
    folder = Path(name)
    shipped = None if folder.exists() else shipped_models().get(str(name))
    return folder if shipped is None else shipped.folder


def say_model(name: Path | str) -> str | None:
    """One line on which model is taken, of a name that is a shipped model's; None of any other."""
    if str(name) not in shipped_models():
        return None
    if Path(name).exists():
        place = Path(name).resolve()
        return f"{name}: the folder {place}, not the model of this name that comes with motionloom"
    return f"{name}: the model that comes with motionloom"


def no_such_model(name: Path | str) -> str:
    """One sentence about a model that is not there, with the nearest folder or the shipped models."""
    said, shipped = no_such_folder(Path(name)), list(shipped_models())
    if not shipped or len(Path(name).parts) != 1:
        return said
    near = difflib.get_close_matches(str(name), shipped, n=1, cutoff=0.6)
    if near:
        return f"{name}: no such folder; did you mean {near[0]}, the model that comes with motionloom?"
    return f"{said}; models that come with motionloom: {', '.join(shipped)}"


def _place() -> Path:
    return Path(str(resources.files("motionloom.models.pretrained")))
