"""The files of a text encoder: where a run's encoder lies, and a copy of it for an exported model."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

from motionloom.datasets.base.places import hub_is_away
from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.text.cache import CacheInfo
from motionloom.pipeline.store.files import remove_tree, write_json

BUILT_IN = "minilm"
"""Comes with the installation, so it is never copied."""

_PLACE = "encoder.json"
_SUFFIXES = (".safetensors", ".json", ".txt", ".model", ".md")
"""What a text encoder's folder may bring along; pickled weights and code stay behind."""


class EncoderPlace(Config):
    """`encoder.json` of a text stage whose encoder is a folder."""

    folder: str
    """Absolute: the recipe may name it from the folder the run was started in."""


def keep_place(spec: str, stage: Path) -> None:
    """Write down where an encoder that is a folder lies; a hub name says so itself."""
    folder = Path(spec).expanduser()
    if spec != BUILT_IN and folder.is_dir():
        write_json(stage / _PLACE, EncoderPlace(folder=str(folder.absolute())).dump())


def place_of(stage: Path) -> str | None:
    """The folder that `keep_place` wrote down, if the encoder is one."""
    path = stage / _PLACE
    return EncoderPlace.load_json(path).folder if path.is_file() else None


def copy_encoder(spec: str, stage: Path, target: Path) -> None:
    """Copy the encoder of a text stage into `target`: from its folder, or from the hub (its cache first).

    The copy is loaded once: it must have the weights that encoded the run's captions.
    """
    from motionloom.datasets.text.encoder import load_text_encoder

    digest = CacheInfo.load_json(stage / "cache" / "cache.json").encoder.rpartition(":")[2]
    problem = ""
    for find in _sources(spec):
        try:
            copy_encoder_files(find(), target)
            if load_text_encoder(str(target)).name.endswith(f":{digest}"):
                return
            problem = "its weights are not those that encoded this run's captions"
        except Exception as error:  # the hub's library raises many kinds
            problem = (str(error).strip().splitlines() or [type(error).__name__])[0]
        remove_tree(target)
    raise UserError(
        f"text encoder '{spec}' cannot be copied ({problem}); put the model back where the text stage found "
        f"it: in its folder, seen from where the run was started, or on the hub or in the hub's cache"
    )


def _sources(spec: str) -> list[Callable[[], Path]]:
    """Ways to a folder that holds the encoder, in the order to be tried."""
    from huggingface_hub import snapshot_download

    folder = Path(spec).expanduser()
    if folder.is_dir() or folder.is_absolute():
        return [lambda: folder]
    patterns = [f"*{suffix}" for suffix in _SUFFIXES]

    def fetched(only_cached: bool) -> Path:
        return Path(snapshot_download(spec, allow_patterns=patterns, local_files_only=only_cached))

    return [partial(fetched, only_cached) for only_cached in ((True,) if hub_is_away() else (True, False))]


def copy_encoder_files(source: Path, target: Path) -> None:
    """Copy the files of an encoder that may be exported: no pickled weights, no code."""
    if not source.is_dir():
        raise UserError(f"{source}: no such folder")
    for path in sorted(source.rglob("*")):
        if path.is_file() and path.suffix in _SUFFIXES:
            copy = target / path.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
