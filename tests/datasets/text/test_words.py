"""Words that training had, nearly had, or never had."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.datasets.text.words import HeardWords, one_slip, words_of

TRAINED = ("A boy bends the knee twice.", "someone kicks with the left leg, and waves")


@pytest.mark.parametrize(
    ("caption", "unheard"),
    [
        ("she kicks with her left leg", []),
        ("a guy bends his knees", []),
        ("somone wavess", []),
        ("kiks", []),
        ("he doesn't kick", ["doesn't"]),
        ("she never waves", ["never"]),
        ("kick 7 times", ["7", "times"]),
        ("kick three legs", ["three"]),
        ("play the violin", ["play", "violin"]),
    ],
)
def test_words_that_decide_a_motion_are_missed(caption: str, unheard: list[str]) -> None:
    words = heard(TRAINED)
    assert words.unheard(words.spelt(caption)) == unheard


def heard(captions: tuple[str, ...]) -> HeardWords:
    encoder = load_text_encoder("minilm")

    def pieces(words: Sequence[str]) -> NDArray[np.int64]:
        return encoder.encode(words).mask.sum(axis=1, dtype=np.int64) - 2

    return HeardWords(words_of(captions), lambda texts: encoder.encode(texts).sentence, pieces)


@pytest.mark.parametrize(
    ("said", "read"),
    [
        ("Somone kiks twicee", "someone kicks twice"),
        ("the lfet leg wavess", "the left leg waves"),
        ("wades and kids", "wades and kids"),
        ("no kick, 7 waves", "no kick, 7 waves"),
    ],
)
def test_a_misspelt_word_is_read_as_the_one_that_is_meant(said: str, read: str) -> None:
    """Words that are English are other words, however near: "kids" is no slip of "kick"."""
    assert heard(TRAINED).spelt(said) == read


def test_nothing_is_missed_where_words_were_not_kept() -> None:
    words = HeardWords(frozenset(), lambda _: pytest.fail("compared"), lambda _: pytest.fail("cut"))
    assert words.unheard("a violin") == [] and words.spelt("a vilin") == "a vilin"


def test_one_slip() -> None:
    for word in ("knck", "kock", "kiick", "kcik", "kick"):
        assert one_slip(word, "kick"), word
    assert not one_slip("tick", "kick") and not one_slip("sat", "sit")
