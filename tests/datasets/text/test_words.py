"""Words that training had, nearly had, or never had."""

from __future__ import annotations

import pytest

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
    encoder = load_text_encoder("minilm")
    words = HeardWords(words_of(TRAINED), lambda texts: encoder.encode(texts).sentence)
    assert words.unheard(caption) == unheard


def test_nothing_is_missed_where_words_were_not_kept() -> None:
    assert HeardWords(frozenset(), lambda _: pytest.fail("nothing to compare")).unheard("a violin") == []


def test_one_slip() -> None:
    for word in ("knck", "kock", "kiick", "kcik", "kick"):
        assert one_slip(word, "kick"), word
    assert not one_slip("tick", "kick") and not one_slip("sat", "sit")
