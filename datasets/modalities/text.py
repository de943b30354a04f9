"""Captions: word features and a sentence embedding (UDE section 3.2, HumanTOMATO section 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from motionloom.datasets.modalities.modality import Clips, Modality, Rows
from motionloom.datasets.schema import UserError

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
        import torch

        from motionloom.datasets.conditions import Condition

        cache, count = cast("TextCache", reader), len(rows.captions)
        with_text = np.flatnonzero(rows.present)
        chosen = [rows.captions[row] for row in with_text.tolist()]
        tokens, known = cache.tokens(chosen)
        # A batch without any text keeps one position, so that attention has something to mask.
        places = max(1, tokens.shape[1])
        features = np.zeros((count, places, cache.dim), dtype=np.float32)
        mask = np.zeros((count, places), dtype=np.bool_)
        pooled = np.zeros((count, cache.dim), dtype=np.float32)
        if len(with_text):
            features[with_text], mask[with_text], pooled[with_text] = tokens, known, cache.sentence(chosen)
        return Condition(torch.from_numpy(features), torch.from_numpy(mask), torch.from_numpy(pooled))

    def encode(self, prepared: object, values: Sequence[object | None], fps: float) -> Condition:
        import torch

        from motionloom.datasets.conditions import Condition

        if prepared is None:
            raise UserError("this model has no text encoder; leave the text out")
        words = ["" if text is None else str(text) for text in values]
        encoded = cast(_Prepared, prepared).encoder.encode(words)
        features, mask = torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask)
        pooled = torch.as_tensor(encoded.sentence)
        has_text = torch.tensor([bool(text.strip()) for text in words])
        if not has_text.all():
            mask = mask & has_text[:, None]
            features, pooled = features * mask[..., None], pooled * has_text[:, None]
        return Condition(features, mask, pooled)

    def example(self, batch: int, frames: int, width: int) -> Condition:
        import torch

        from motionloom.datasets.conditions import Condition

        mask = torch.ones(batch, _WORDS, dtype=torch.bool)
        return Condition(torch.empty(batch, _WORDS, width), mask, torch.empty(batch, width))


RECORD = TextModality()
