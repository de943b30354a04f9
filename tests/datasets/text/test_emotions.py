"""Emotion words of captions."""

from __future__ import annotations

import pytest

from motionloom.datasets.text.emotions import emotion_of


@pytest.mark.parametrize(
    ("captions", "emotion"),
    [
        (["A person happily waves."], "happy"),
        (["someone walks", "someone walks, smiling"], "happy"),
        (["he is unhappy"], "sad"),
        (["she does not smile"], None),
        (["without anger he turns"], None),
        (["a person laughs and then cries"], None),
        (["a person made a cake"], None),
        ([], None),
    ],
)
def test_emotions(captions: list[str], emotion: str | None) -> None:
    assert emotion_of(captions) == emotion
