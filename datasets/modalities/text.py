"""Captions: word features and a sentence embedding (UDE section 3.2, HumanTOMATO section 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.modalities.modality import Clips, Modality, Rows, condition_of

if TYPE_CHECKING:
    from motionloom.datasets.conditions import Condition
    from motionloom.datasets.text.cache import TextCache
    from motionloom.datasets.text.encoder import TextEncoder

_WORDS = 24
"""Words of a long caption."""


class _Prepared(Protocol):
    """Output of a text stage."""

    @property
    def cache(self) -> TextCache: ...
    @property
    def encoder(self) -> TextEncoder: ...


class TextModality(Modality):
    """Captions as words and sentences."""

    name = "text"
    members = ("texts.json",)

    def reader(self, prepared: object) -> object:
        return cast(_Prepared, prepared).cache

    def batch(self, reader: object, dataset: Clips, rows: Rows) -> Condition:
        """Word features [B, L, E] and unit sentence embeddings [B, E] of the rows' captions."""
        cache = cast("TextCache", reader)
        count = len(rows.captions)
        with_text = np.flatnonzero(rows.present)
        chosen = [rows.captions[row] for row in with_text.tolist()]
        tokens, known = cache.tokens(chosen)
        if len(chosen) == count:
            return condition_of(tokens, known, cache.sentence(chosen))
        # A batch without any text keeps one position, so that attention has something to mask.
        places = max(1, tokens.shape[1])
        features = np.zeros((count, places, cache.dim), dtype=np.float32)
        mask = np.zeros((count, places), dtype=np.bool_)
        pooled = np.zeros((count, cache.dim), dtype=np.float32)
        if len(with_text):
            features[with_text] = tokens
            mask[with_text] = known
            pooled[with_text] = cache.sentence(chosen)
        return condition_of(features, mask, pooled)

    def encode(self, prepared: object, values: Sequence[object | None], fps: float) -> Condition:
        if prepared is None:
            raise UserError("this model has no text encoder; leave the text out")
        words = ["" if text is None else str(text) for text in values]
        encoded = cast(_Prepared, prepared).encoder.encode(words)
        features = encoded.tokens
        mask = encoded.mask
        pooled = encoded.sentence
        has_text = np.array([bool(text.strip()) for text in words])
        if not has_text.all():
            mask = mask & has_text[:, None]
            features = features * mask[..., None]
            pooled = pooled * has_text[:, None]
        return condition_of(features, mask, pooled)

    def example(self, batch: int, frames: int, width: int) -> Condition:
        features = np.empty((batch, _WORDS, width), np.float32)
        pooled = np.empty((batch, width), np.float32)
        return condition_of(features, np.ones((batch, _WORDS), np.bool_), pooled)


RECORD = TextModality()
