"""The trained models that come with the package, and which folder a model's name means.

Each is an exported folder in `models/pretrained/` with its card (`README.md`), known by the folder's name:
`motionloom generate synthetic "a person waves"`. A folder of that name in the current directory goes first.
"""

from __future__ import annotations

import atexit
import difflib
import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from motionloom.datasets.base.places import no_such_folder
from motionloom.pipeline.store.outside import BUNDLE_FILE

CARD_FIGURES = "card.json"
"""Beside a model's card: its figures, and what it is in one line."""


@dataclass(frozen=True)
class ShippedModel:
    """A model that comes with the package."""

    name: str
    place: Traversable

    @property
    def bytes(self) -> int:
        """Size of all its files."""
        return _size(self.place)

    @property
    def description(self) -> str:
        """What it is, in one line; empty where its card does not say."""
        try:
            facts = json.loads((self.place / CARD_FIGURES).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return ""
        return str(facts.get("description", "")) if isinstance(facts, dict) else ""

    @property
    def folder(self) -> Path:
        """Its folder on disk; out of a packed installation it is unpacked once a process."""
        return self.place if isinstance(self.place, Path) else _unpacked(self.name)


def shipped_models() -> dict[str, ShippedModel]:
    """The models that come with this installation, by name; none where it was made without their weights."""
    found = (ShippedModel(one.name, one) for one in _place().iterdir() if (one / BUNDLE_FILE).is_file())
    return {model.name: model for model in sorted(found, key=lambda model: model.name)}


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


def _place() -> Traversable:
    return resources.files("motionloom.models.pretrained")


def _size(place: Traversable) -> int:
    if isinstance(place, Path):
        return place.stat().st_size if place.is_file() else sum(_size(one) for one in place.iterdir())
    return len(place.read_bytes()) if place.is_file() else sum(_size(one) for one in place.iterdir())


@cache
def _unpacked(name: str) -> Path:
    """A copy of a model on disk, until the process ends."""
    keep = ExitStack()
    atexit.register(keep.close)
    out = Path(keep.enter_context(tempfile.TemporaryDirectory(prefix="motionloom-"))) / name
    _copy(_place() / name, out)
    return out


def _copy(place: Traversable, out: Path) -> None:
    if place.is_file():
        out.write_bytes(place.read_bytes())
        return
    out.mkdir()
    for one in place.iterdir():
        _copy(one, out / one.name)
