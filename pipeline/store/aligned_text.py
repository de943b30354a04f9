"""Captions in a space that is aligned with motion: TMA's text latents in the place of word features.

TMA has seen which words go with which motion before a token model reads them, so a caption that combines
known words anew lies where its motion does (HumanTOMATO section 3.5, where it is the GPT's prior). For UDE's
MATE, which learns from tokens alone, this is ours.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import SIMILARITY, TextCache
from motionloom.datasets.text.encoder import EncodedText, TextEncoder
from motionloom.pipeline.store.known_captions import KnownCaptions
from motionloom.pipeline.store.networks import LoadedTma
from motionloom.pipeline.store.text import TextSource


@dataclass(frozen=True)
class AlignedEncoder:
    """A `TextEncoder`: one token a caption, TMA's latent [E]; its sentence embedding is that of length 1."""

    tma: LoadedTma
    words: Callable[[Sequence[str]], EncodedText]
    """Features of the words that `tma` was trained on."""
    words_name: str

    @property
    def dim(self) -> int:
        """E, the width of TMA's latents."""
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
        """See `TextEncoder`."""
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
        """Width of TMA's latents."""
        return self.tma.net.config.latent

    @cached_property
    def encoder(self) -> TextEncoder:
        """Words, then TMA."""
        return AlignedEncoder(self.tma, self.words.encoder.encode, self.words.encoder.name)

    @cached_property
    def known(self) -> Mapping[str, KnownCaptions]:
        """As the words have them."""
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
        """See `TextEncoder`."""
        sentence = self._cache.similarity(captions)
        return EncodedText(sentence, sentence[:, None], np.ones((len(sentence), 1), dtype=bool))
