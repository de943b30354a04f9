"""The folder that a model's name means: one that is there, a model of the package, or one of the hub.

Those of the package are exported folders in `models/pretrained/` with their card (`README.md`), known by
the folder's name: `motionloom generate synthetic "a person waves"`. A run or an export of that name in the
current directory goes first; another folder hides none.
"""

from __future__ import annotations

import difflib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.places import hub_is_away, means_folder, no_such_folder
from motionloom.pipeline.store.run_folder import BUNDLE_FILE

_FILES = ["*.json", "*.safetensors", "*.txt", "*.model"]
"""Files of an export; a hub's folder may hold others."""
_HUB_OPTIONS = ("revision", "token", "cache_dir", "force_download", "local_files_only")
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
    """The folder that a name means: a run or export, else a model of the package, else that folder."""
    folder = Path(name)
    is_model = any((folder / file).is_file() for file in (BUNDLE_FILE, "recipe.yaml"))
    shipped = None if is_model else shipped_models().get(str(name))
    return folder if shipped is None else shipped.folder


def find_model(name: Path | str, **options: Any) -> Path:
    """The folder of a model: as `model_folder`, or else, of a name `owner/name`, a copy from the hub.

    `options` are the hub's, `_HUB_OPTIONS`. Raises `UserError`
    where no folder, no model of the package and no model of the hub has this name; a `Path` is no hub name.
    """
    for option in options.keys() - set(_HUB_OPTIONS):
        raise UserError(f"{option}: no such option{nearest(option, ('device', *_HUB_OPTIONS))}")
    folder = model_folder(name)
    if folder.exists():
        return folder
    if isinstance(name, Path) or "/" not in name or means_folder(name):
        raise UserError(no_such_model(name))
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    away = hub_is_away()
    if away:
        options["local_files_only"] = True
    try:
        return Path(snapshot_download(name, allow_patterns=_FILES, **options))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if away:
            reason = "it cannot be reached from here, and its cache does not hold it"
        raise UserError(
            f"{name}: no such folder, no model of that name comes with motionloom, and the hub does not give "
            f"it ({reason})"
        ) from None


def no_such_model(name: Path | str) -> str:
    """One sentence about a model that is not there, with the nearest folder or the shipped models."""
    said = no_such_folder(Path(name))
    shipped = list(shipped_models())
    if not shipped or len(Path(name).parts) != 1:
        return said
    near = difflib.get_close_matches(str(name), shipped, n=1, cutoff=0.6)
    if near:
        return f"{name}: no such folder; did you mean {near[0]}, the model that comes with motionloom?"
    return f"{said}; models that come with motionloom: {', '.join(shipped)}"


def _place() -> Path:
    return Path(str(resources.files("motionloom.models.pretrained")))
