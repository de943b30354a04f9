"""What a text stage gives: its cache of encoded captions, and the encoder that made it, for new words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.schema import Config, UserError
from motionloom.datasets.text.cache import TextCache, key_of
from motionloom.datasets.text.encoder import TextEncoder, load_text_encoder
from motionloom.pipeline.store.encoder_files import BUILT_IN, copy_encoder, copy_encoder_files, place_of
from motionloom.pipeline.store.files import copy_files, write_json
from motionloom.pipeline.store.known_captions import KNOWN_FILES, KnownCaptions, Unknown, load_known

_EXPORTED = "text.json"
_COPY = "encoder"
_KNOWN_WIDTHS = {BUILT_IN: 384, "openai/clip-vit-base-patch32": 512}
_USUAL_WIDTH = 768
"""Of DistilBERT and CLIP ViT-L/14, assumed for encoders that are not loaded to look."""


class ExportedText(Config):
    """`text.json` of an exported text stage."""

    encoder: str
    """`minilm`, or the folder beside this file."""
    dim: int


@dataclass(frozen=True)
class TextPreview:
    """What is known of a text stage before it has run."""

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
    """In an export, where `text.json` says which encoder, and `named` plays no part."""

    @cached_property
    def cache(self) -> TextCache:
        """The captions of the data, encoded; an export has none."""
        return TextCache.open(self.folder / "cache")

    @cached_property
    def dim(self) -> int:
        """Width of its features."""
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
        if not self.exported and all(self.cache.row(key_of(text)) is not None for text in captions):
            return self.cache.tokens(captions)
        encoded = self.encoder.encode(captions)
        return encoded.tokens, encoded.mask

    @cached_property
    def known(self) -> Mapping[str, KnownCaptions]:
        """Captions that stand for those of the training, "body" and "face"; none where they were not kept."""
        return load_known(self.folder)

    def unknown(self, captions: Sequence[str], *, face: bool = False) -> list[Unknown]:
        """Those of `captions` that are far from all that were trained on."""
        known = self.known.get("face" if face else "body")
        if known is None or not captions:
            return []
        return known.unknown(captions, self._sentences.encode(captions).sentence)

    @cached_property
    def _sentences(self) -> TextEncoder:
        """The encoder of `known`."""
        if self.encoder_name == BUILT_IN:
            return self.encoder
        return load_text_encoder(BUILT_IN, device=str(self.device))

    def export(self, target: Path) -> None:
        """What encoding new words needs; an encoder that comes with the installation is not copied."""
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
