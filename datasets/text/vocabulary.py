"""The words of the training's captions, by which misspelt words of a new caption are corrected [ours].

A text encoder cuts a misspelt word into pieces that mean something else. A word that is none, one slip of a
letter away from one of training's, is therefore replaced by that one before a caption is encoded.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pieces = Callable[[Sequence[str]], NDArray[np.int64]]
"""Words to the number of pieces [n] that a text encoder cuts each into: it knows English words whole."""

_ENDINGS = ("s", "es", "d", "ed", "ing")
_WORD = r"[\w']+"


def words_in(caption: str) -> list[str]:
    """The words of a caption in their order, in small letters."""
    return re.findall(_WORD, caption.lower())


def word_counts(captions: Collection[str]) -> Mapping[str, int]:
    """Return the number of occurrences of each word of captions, in small letters."""
    return Counter(word for caption in captions for word in words_in(caption))


@dataclass(frozen=True)
class Vocabulary:
    """The words of a training's captions, with how often each came, as far as that is known."""

    words: frozenset[str]
    counts: Mapping[str, int]
    pieces: Pieces

    def spelled(self, caption: str) -> str:
        """Return a caption with its misspelt words corrected."""
        return re.sub(_WORD, lambda found: self._corrected(found[0]), caption) if self.words else caption

    def _corrected(self, word: str) -> str:
        small = word.lower()
        if small in self.words:
            return word
        # Of several words at one slip, the one that training had most often is the likeliest to be meant.
        near = sorted((known for known in self.words if one_slip(small, known)), key=self._rarity)
        return near[0] if near and not self._is_english(small) else word

    def _rarity(self, word: str) -> tuple[int, str]:
        return -self.counts.get(word, 0), word

    def _is_english(self, word: str) -> bool:
        """Whether the encoder knows a word, or what it is a form of, as one that training has not."""
        forms = {word, *(word.removesuffix(end) for end in _ENDINGS)} - self.words
        return bool((self.pieces(sorted(forms)) == 1).any())


def one_slip(word: str, known: str) -> bool:
    """Whether a word is `known`, of four letters or more, but for a letter or two swapped, not the first."""
    if len(known) < 4 or word[:1] != known[0] or abs(len(word) - len(known)) > 1:
        return False
    same = next((k for k, pair in enumerate(zip(word, known, strict=False)) if pair[0] != pair[1]), None)
    if same is None:
        return True
    a, b = word[same:], known[same:]
    # A letter replaced, one too many, one missing, or two swapped.
    return a[1:] == b[1:] or a[1:] == b or a == b[1:] or (a[1::-1] == b[:2] and a[2:] == b[2:])
