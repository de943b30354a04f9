"""Text encoders in a few lines, for tests that need captions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from motionloom.datasets.loading.condition_batches import ConditionBatches
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText


class OneToken:
    """A text encoder that says the same of everything."""

    name, dim = "one-token", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        ones = np.ones((len(captions), 1, 4), dtype=np.float32)
        return EncodedText(ones[:, 0] / 2, ones, np.ones((len(captions), 1), dtype=bool))


class WordLengths:
    """One token a word, all its values the word's length."""

    name, dim = "word-lengths", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        words = [caption.split() for caption in captions]
        tokens = np.zeros((len(words), max(map(len, words)), 4), dtype=np.float32)
        for row, own in zip(tokens, words, strict=True):
            row[: len(own)] = np.array([len(word) for word in own])[:, None]
        return EncodedText(np.full((len(words), 4), 0.5, dtype=np.float32), tokens, tokens[..., 0] > 0)


def caption_batches(
    dataset: Any, stats: Any, text: TextCache, *, about: Any = "body", **options: Any
) -> ConditionBatches:
    """Batches of captioned clips."""
    return ConditionBatches(dataset, stats, {"text": text}, captioned=about, **options)
