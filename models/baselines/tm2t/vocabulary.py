"""The words of captions and their numbers.

A word is letters and digits with inner hyphens and apostrophes, in lower case; punctuation is none. Numbers 0
to 3 are padding, Start, End and a word that is not in the vocabulary, which is read and never written.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from motionloom.models.metrics.captions import words_of

PAD, START, END, UNKNOWN = range(4)
FIRST = 4
"""Number of the first word."""


@dataclass(frozen=True)
class Vocabulary:
    """Words in the order of their numbers."""

    words: tuple[str, ...]

    @staticmethod
    def of(captions: Iterable[str], *, most: int, least_uses: int) -> Vocabulary:
        """The `most` frequent words of captions, of those that `least_uses` different captions have."""
        uses = Counter(word for caption in dict.fromkeys(captions) for word in set(words_of(caption)))
        order = sorted(uses, key=lambda word: (-uses[word], word))
        return Vocabulary(tuple(word for word in order if uses[word] >= least_uses)[:most])

    def __len__(self) -> int:
        """Words and the four others."""
        return FIRST + len(self.words)

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {word: FIRST + number for number, word in enumerate(self.words)}

    def encode(self, captions: Sequence[str], longest: int) -> Tensor:
        """Captions -> int64 [n, W]: words and End, padded; only the first `longest` words are kept."""
        rows = [
            [*(self._numbers.get(word, UNKNOWN) for word in words_of(caption)[:longest]), END]
            for caption in captions
        ]
        out = torch.full((len(rows), max(map(len, rows), default=1)), PAD)
        for row, numbers in enumerate(rows):
            out[row, : len(numbers)] = torch.tensor(numbers)
        return out

    def decode(self, numbers: Iterable[int]) -> str:
        """A sentence of words' numbers."""
        return " ".join(self.words[number - FIRST] for number in numbers)
