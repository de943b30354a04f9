"""The result of a text stage: its cache of encoded captions, and the encoder that made it, for new words.

An export brings a copy of the encoder along.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.places import hub_is_away
from motionloom.datasets.text.cache import CacheInfo, TextCache
from motionloom.datasets.text.encoder import TextEncoder, load_text_encoder
from motionloom.pipeline.store.files import copy_files, remove_tree, write_json
from motionloom.pipeline.store.known_captions import (
    KNOWN_FILES,
    KnownCaptions,
    KnownTexts,
    Unknown,
    is_english,
    load_known,
)

BUILT_IN = "minilm"
"""Comes with the installation, so it is never copied."""

_PLACE = "encoder.json"
_SUFFIXES = (".safetensors", ".json", ".txt", ".model", ".md")
"""Suffixes of a text encoder's files that are copied; pickled weights and code stay behind."""
_EXPORTED = "text.json"
_COPY = "encoder"
_KNOWN_WIDTHS = {BUILT_IN: 384, "openai/clip-vit-base-patch32": 512}
_MARKS = 2
"""Tokens that MiniLM puts around a caption."""
_USUAL_WIDTH = 768
"""Width of DistilBERT and CLIP ViT-L/14, assumed for encoders that are not loaded to look."""


class ExportedText(Config):
    """`text.json` of an exported text stage."""

    encoder: str
    """`minilm`, or the folder beside this file."""
    dim: int


@dataclass(frozen=True)
class TextPreview:
    """The width of a text stage's features before it has run."""

    dim: int

    @staticmethod
    def of(encoder: str) -> TextPreview:
        """Width of an encoder's features, or what most have."""
        return TextPreview(_KNOWN_WIDTHS.get(encoder, _USUAL_WIDTH))


@dataclass(frozen=True)
class TextSource:
    """A finished text stage, in a run or in an export."""

    folder: Path
    named: str
    """The encoder as its config names it."""
    device: torch.device
    exported: bool = False
    """Whether it is in an export, where `text.json` names the encoder, and `named` is ignored."""

    @cached_property
    def cache(self) -> TextCache:
        """The captions of the data, encoded; an export has none."""
        return TextCache.open(self.folder / "cache")

    @cached_property
    def dim(self) -> int:
        if self.exported:
            return ExportedText.load_json(self.folder / _EXPORTED).dim
        return self.cache.dim

    @property
    def encoder_name(self) -> str:
        """The encoder to load; in an export, nothing outside its folder is ever followed."""
        if not self.exported:
            return place_of(self.folder) or self.named
        name = ExportedText.load_json(self.folder / _EXPORTED).encoder
        if name == BUILT_IN:
            return name
        if name in {"", ".", ".."} or "/" in name or "\\" in name or not (self.folder / name).is_dir():
            raise UserError(
                f"{self.folder / _EXPORTED}: encoder = {name!r} is neither '{BUILT_IN}' nor a folder beside "
                f"this file; export the run again"
            )
        return str(self.folder / name)

    @cached_property
    def encoder(self) -> TextEncoder:
        """Loaded on first use; it is the slow part of starting."""
        return load_text_encoder(self.encoder_name, device=str(self.device))

    def tokens(self, captions: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Token features [n, S, E] and the mask [n, S] of captions: as the cache has them, or, where one is
        missing there (captions of another run's data, an export), by the encoder.
        """
        if not self.exported and (self.cache.find(captions) >= 0).all():
            return self.cache.tokens(captions)
        encoded = self.encoder.encode(captions)
        return encoded.tokens, encoded.mask

    @property
    def known(self) -> Mapping[str, KnownCaptions]:
        """Captions that represent those of the training, "body" and "face"; none where they were not kept."""
        return self._known[1]

    @property
    def actions(self) -> tuple[str, ...]:
        """The actions of the training's clips, where these state their truth."""
        return self._known[0].actions

    @cached_property
    def _known(self) -> tuple[KnownTexts, dict[str, KnownCaptions]]:
        return load_known(self.folder)

    def unknown(
        self,
        captions: Sequence[str],
        *,
        face: bool = False,
        judge: Callable[[str], bool | None] = lambda _: None,
        suits: Callable[[str, str], bool] = lambda *_: True,
    ) -> list[Unknown]:
        """Return those of `captions` that are unlike all that were trained on, each once.

        `judge` says of some captions whether they are known; where it returns None, distance decides. `suits`
        says of a caption and one of the training's whether that may be named beside it.
        """
        known = self.known.get("face" if face else "body")
        different = list(dict.fromkeys(captions))
        if known is None or not different:
            return []
        out = []
        encoded = self._sentences.encode(different)
        pieces = (encoded.mask.sum(1) - _MARKS).tolist()
        for caption, vector, count in zip(different, encoded.sentence, pieces, strict=True):
            is_known = judge(caption)
            if is_known is None:
                is_known = not known.is_far(vector)
            if is_known:
                continue
            if known.english and not is_english(caption, count):
                out.append(Unknown(caption, english=False))
            else:
                out.append(Unknown(caption, known.nearest(vector, partial(suits, caption))))
        return out

    @cached_property
    def _sentences(self) -> TextEncoder:
        if self.encoder_name == BUILT_IN:
            return self.encoder
        return load_text_encoder(BUILT_IN, device=str(self.device))

    def export(self, target: Path) -> None:
        """Copy what encoding new words needs; an encoder that comes with the installation is not copied."""
        target.mkdir(parents=True, exist_ok=True)
        copy_files(self.folder, target, [name for name in KNOWN_FILES if (self.folder / name).is_file()])
        name = self.encoder_name
        if name != BUILT_IN:
            if self.exported:
                copy_encoder_files(Path(name), target / _COPY)
            else:
                copy_encoder(name, self.folder, target / _COPY)
            name = _COPY
        write_json(target / _EXPORTED, ExportedText(encoder=name, dim=self.dim).dump())


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
