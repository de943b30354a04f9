"""Captions as TMA's latents: a text stage for models that shall read words in a space aligned with motion."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from motionloom.datasets.schema import UserError
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import SIMILARITY, TextCache
from motionloom.datasets.text.encoder import EncodedText, TextEncoder
from motionloom.pipeline.contract.stage import (
    ALIGNMENT,
    Finished,
    Inputs,
    Stage,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.known_captions import KnownCaptions
from motionloom.pipeline.store.networks import LoadedTma
from motionloom.pipeline.store.run_folder import is_place
from motionloom.pipeline.store.text import TextPreview, TextSource
from motionloom.pipeline.training.warm_start import same_encoder


class AlignedTextConfig(StageConfig):
    """Nothing to choose: the latents are those of its TMA."""


class AlignedTextStage(StageKind):
    """TMA's latent of every caption, in the place of a text encoder's features."""

    name = "aligned_text"
    summary = "captions as TMA's latents"
    config = AlignedTextConfig
    takes = ("text", f"tma: {ALIGNMENT}")

    def gives(self, config: Any) -> frozenset[str]:
        return frozenset({"text"})

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """The TMA must be given captions as the encoder made them that it was trained on."""
        own, tma = stage.inputs["text"], others[stage.inputs["tma"]]
        theirs = tma.inputs.get("text", own)
        if theirs != own and not (is_place(theirs) and same_encoder(theirs, own, others)):
            raise UserError(
                f"stage '{stage.name}' reads captions of '{own}' and its TMA '{tma.name}' was trained on "
                f"those of '{tma.inputs['text']}'; name that one: inputs: {{text: {tma.inputs['text']}}}"
            )

    def run(self, context: StageContext) -> None:
        given = context.given
        folder, show = context.folder / "cache", context.console.is_terminal
        cache = build_aligned_cache(folder, given["text"].cache, given["tma"], show)
        context.console.print(f"    {len(cache)} different captions, {cache.dim}-d latents")

    def preview(self, config: AlignedTextConfig, given: Inputs) -> TextPreview:
        return TextPreview(given["tma"].net.config.latent)

    def load(self, stage: Finished, given: Inputs, device: torch.device) -> AlignedText:
        return AlignedText(stage.folder, "", device, stage.exported, words=given["text"], tma=given["tma"])

    def exported(self, config: AlignedTextConfig) -> tuple[str, ...]:
        return ("text", "tma")

    def export(self, stage: Finished, target: Path) -> None:
        target.mkdir(parents=True, exist_ok=True)


@dataclass(frozen=True)
class AlignedEncoder:
    """A `TextEncoder`: one token a caption, TMA's latent [E]; its sentence embedding is that of length 1."""

    tma: LoadedTma
    words: Callable[[Sequence[str]], EncodedText]
    """Features of the words that `tma` was trained on."""
    words_name: str

    @property
    def dim(self) -> int:
        return self.tma.net.config.latent

    @cached_property
    def name(self) -> str:
        """The encoder of the words, and TMA's weights."""
        digest = hashlib.sha256()
        for name, value in sorted(self.tma.net.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
        return f"{self.words_name}+tma:{digest.hexdigest()[:12]}"

    def encode(self, captions: Sequence[str]) -> EncodedText:
        words = self.words(captions)
        latent = self.tma.embed_text(torch.as_tensor(words.tokens), torch.as_tensor(words.mask)).cpu()
        unit = torch.nn.functional.normalize(latent, dim=-1).numpy()
        return EncodedText(unit, latent[:, None].numpy(), np.ones((len(latent), 1), dtype=bool))


@dataclass(frozen=True, kw_only=True)
class AlignedText(TextSource):
    """A finished `aligned_text` stage, with what it was made of."""

    words: TextSource
    tma: LoadedTma

    @cached_property
    def dim(self) -> int:
        return self.tma.net.config.latent

    @cached_property
    def encoder(self) -> TextEncoder:
        return AlignedEncoder(self.tma, self.words.encoder.encode, self.words.encoder.name)

    @cached_property
    def known(self) -> Mapping[str, KnownCaptions]:
        return self.words.known

    @cached_property
    def _sentences(self) -> TextEncoder:
        return self.words._sentences

    def export(self, target: Path) -> None:
        """Nothing of its own: the words' encoder and TMA are exported beside it."""
        target.mkdir(parents=True, exist_ok=True)


def build_aligned_cache(folder: Path, words: TextCache, tma: LoadedTma, progress: bool) -> TextCache:
    """Every caption of `words` through `tma`; which captions mean the same stays what `words` says."""

    def read(captions: Sequence[str]) -> EncodedText:
        tokens, mask = words.tokens(captions)
        return EncodedText(words.sentence(captions), tokens, mask)

    captions = set(words.captions_by_key().values())
    build_with_encoder(folder / SIMILARITY, captions, _Similarity(words), progress=False)
    return build_with_encoder(folder, captions, AlignedEncoder(tma, read, words.encoder), progress)


class _Similarity:
    """A `TextEncoder` that reads out what a cache says of likeness."""

    def __init__(self, cache: TextCache) -> None:
        self._cache = cache
        self.name, self.dim = f"{cache.encoder}:similarity", cache.similarity([]).shape[1]

    def encode(self, captions: Sequence[str]) -> EncodedText:
        sentence = self._cache.similarity(captions)
        return EncodedText(sentence, sentence[:, None], np.ones((len(sentence), 1), dtype=bool))


register(AlignedTextStage())
