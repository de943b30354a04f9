"""Words that a model has heard, and those it has not [ours].

A sentence's embedding hardly changes with a negation, a number or a verb, and these decide a motion. So
words are looked at one by one: a word counts as heard if training had it, or had one that means nearly the
same. Words that decide by themselves, which are numbers, those that take others back and those that put one
action after another, must have been in training as they are, and with what else is said. Who moves decides
nothing. A word that is none, one slip of a letter away from one of training's, is read as that one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.text.other_actions import OTHER_ACTIONS
from motionloom.datasets.text.said import Acts

LIKE = 0.75
"""Cosine of single words' embeddings from which they mean nearly the same: "knees" and "knee" have 0.87,
"hello" and "greeting" 0.76, "leaps" and "stepping" 0.65. Chosen on the development part of
`known_words.yaml`."""
LIKE_FORMS = 0.6
"""The same for forms of one word: "comes" and "come" have 0.72, "point" and "pointing" 0.55."""
_NOTHING_ALONE = """
a an the this that these those his her their its my your our i you he she it they we him them of to in on at
by for from with and as is are was be been am while some few who up down very just time times
person people man men woman women boy boys girl girls child children kid kids guy guys lady gentleman human
adult player athlete fighter boxer dancer actor student teacher friend somebody someone one young old
put puts putting go goes going get gets getting give gives giving make makes making take takes taking move
moves moving do does doing
"""
_TAKE_BACK = """
no not never none nor nothing nowhere without instead except anything
dont doesnt didnt isnt arent wasnt wont cant
stop stops stopped refuse refuses refused avoid avoids avoided
"""
_DECIDE = """
zero many two three four five six seven eight nine ten
eleven twelve twenty thirty forty fifty sixty seventy eighty ninety hundred thousand dozen then after
afterwards before
"""
_MOODS = """
happy happily sad sadly unhappy angry angrily surprised calm calmly neutral glad serious
"""
MOODS = frozenset(_MOODS.split())
"""Words of faces that a body's caption may have; how someone feels changes no action of a model of both."""
_IN_TURN = r",?\s*(?:\b(?:and|but)\b)?\s*\b(?:then|afterwards|after (?:that|this|which)|finally)\b,?"
_SAME = {"twice": "two", "thrice": "three", "2": "two", "3": "three", "4": "four", "5": "five"}
_ENDINGS = ("s", "es", "d", "ed", "ing")
_WORD = r"[\w']+"
_SMALL, _BACK = frozenset(_NOTHING_ALONE.split()), frozenset([*_TAKE_BACK.split(), "nobody"])
_EXACT = _BACK | frozenset(_DECIDE.split())

Understood = tuple[str, Sequence[Acts]]
"""A caption as it is read, its words spelt right, and what it may ask for; empty where that is not known."""
Encode = Callable[[Sequence[str]], NDArray[np.float32]]
"""Captions or words to unit-length embeddings [n, E]."""
Pieces = Callable[[Sequence[str]], NDArray[np.int64]]
"""Words to the number of pieces [n] that a text encoder cuts each into: it knows English words whole."""


def words_of(captions: Collection[str]) -> frozenset[str]:
    """The different words of captions, in small letters."""
    return frozenset(word for caption in captions for word in words_in(caption))


def counted(captions: Collection[str]) -> Mapping[str, int]:
    """How often captions have each of their words, in small letters."""
    return Counter(word for caption in captions for word in words_in(caption))


def words_in(caption: str) -> list[str]:
    """The words of a caption in their order, in small letters."""
    return re.findall(_WORD, caption.lower())


@dataclass(frozen=True)
class HeardWords:
    """The words of a training's captions, and what embeds others for comparison."""

    words: frozenset[str]
    encode: Encode
    pieces: Pieces
    often: Mapping[str, int] = field(default_factory=dict)
    """How often training had a word, as far as it is known; of two slips the likelier word is meant."""

    def spelt(self, caption: str) -> str:
        """A caption whose misspelt words are those of training that they are meant to be."""
        return re.sub(_WORD, lambda found: self._meant(found[0]), caption) if self.words else caption

    def _meant(self, word: str) -> str:
        small = word.lower()
        if small in self.words or small in _SMALL | _EXACT:
            return word
        near = [known for known in self.words if one_slip(small, known)]
        near.sort(key=lambda known: (-self.often.get(known, 0), known))
        return near[0] if near and not self._english(small) else word

    def _english(self, word: str) -> bool:
        """Whether the encoder knows a word, or what it is a form of, as one that training has not."""
        forms = {word, *(word.removesuffix(end) for end in _ENDINGS)} - self.words
        return bool((self.pieces(sorted(forms)) == 1).any())

    def unheard(self, caption: str) -> list[str]:
        """Words of a caption that training had nothing like; empty where its words are not known."""
        return [word for word in words_in(caption) if not self._heard(word)] if self.words else []

    def _heard(self, word: str) -> bool:
        if word in self.words or word in _SMALL:
            return True
        if decides(word):
            return bool(deciding(word) & deciding(" ".join(self.words)))
        cosines = self._embeddings @ self.encode([word])[0]
        if cosines.max() >= LIKE:
            return True
        return any(
            cosine >= LIKE_FORMS and _stem(known) == _stem(word)
            for known, cosine in zip(sorted(self.words), cosines, strict=True)
        )

    @cached_property
    def others(self) -> NDArray[np.float32]:
        """Embeddings of what no training of synthetic clips has [n, E]."""
        return self.encode(OTHER_ACTIONS)

    @cached_property
    def _embeddings(self) -> NDArray[np.float32]:
        return self.encode(sorted(self.words))


def decides(word: str) -> bool:
    """Whether a word in small letters says how often, in which order, or that something is not done."""
    return word in _EXACT or "n't" in word or any(letter.isdigit() for letter in word)


def taken_back(caption: str) -> bool:
    """Whether a caption says that something is not done; who dances like nobody is watching dances."""
    words = words_in(caption)
    return words[:1] == ["nobody"] or any("n't" in word or word in _BACK - {"nobody"} for word in words)


def deciding(caption: str) -> frozenset[str]:
    """The words of a caption that decide by themselves, one spelling for each number."""
    words = (_SAME.get(word, word) for word in words_in(caption))
    return frozenset(word for word in words if decides(word))


def by_words(caption: str) -> Understood:
    """How captions are understood where it is not known what those of the training ask for."""
    return caption, ()


def in_turn(caption: str) -> list[str]:
    """The parts of a caption that puts one action after another."""
    parts = (part.strip(" ,.") for part in re.split(_IN_TURN, caption, flags=re.IGNORECASE))
    return [part for part in parts if part]


def _stem(word: str) -> str:
    """What a word is a form of, without a last "e"."""
    return re.sub(r"(?<=\w{3})(s|es|d|ed|ing|e)$", "", word)


def one_slip(word: str, known: str) -> bool:
    """Whether a word is `known`, of four letters or more, but for a letter or two swapped, not the first."""
    if len(known) < 4 or word[:1] != known[0] or abs(len(word) - len(known)) > 1:
        return False
    same = next((k for k, pair in enumerate(zip(word, known, strict=False)) if pair[0] != pair[1]), None)
    if same is None:
        return True
    a, b = word[same:], known[same:]
    return a[1:] == b or a == b[1:] or a[1:] == b[1:] or (a[1::-1] == b[:2] and a[2:] == b[2:])
