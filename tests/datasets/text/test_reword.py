"""Rewordings: which words may stand for which, what becomes of a caption, and how training draws them."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.schema import UserError
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText
from motionloom.datasets.text.reword import RewordConfig, Rewordings, neighbours, reword, whole_words

ANGLE = {
    **{"walks": 0, "strolls": 10, "wanders": 30, "runs": 90, "jogs": 95, "sprints": 84},
    **{"left": 180, "right": 185, "leftward": 178, "rightward": 187},
    **{"unlike": 270, "someone": 225, "somebody": 228},
}
"""Words on a circle, in degrees: the cosine of two is that of their difference."""


class Circle:
    """An encoder of words at their angles; a caption is the sum of its words, and one token a word."""

    name, dim = "circle", 2

    def encode(self, captions: Sequence[str]) -> EncodedText:
        words = [caption.rstrip(".").split() for caption in captions]
        angles = [np.radians([ANGLE.get(word, 315) for word in row]) for row in words]
        tokens = np.zeros((len(words), max(map(len, words)), 2), dtype=np.float32)
        for row, angle in zip(tokens, angles, strict=True):
            row[: len(angle)] = np.stack([np.cos(angle), np.sin(angle)], 1)
        sentence = tokens.sum(1)
        sentence /= np.linalg.norm(sentence, axis=1, keepdims=True)
        return EncodedText(sentence, tokens, np.abs(tokens).sum(-1) > 0)


CAPTIONS = ["someone walks left.", "someone walks right.", "someone runs left.", "someone runs right."]
CONFIG = RewordConfig(replace=0.5, drop=0.2, nearness=0.8)


def test_neighbours_are_near_and_in_no_caption() -> None:
    near = neighbours(CAPTIONS, sorted(ANGLE), Circle(), CONFIG)
    # "left" and "right" are as alike as "runs" and "jogs", but captions speak of both.
    assert near["walks"] == ["strolls", "wanders"]
    assert near["runs"] == ["jogs", "sprints"]
    assert near["someone"] == ["somebody"]
    assert near["left"] == ["leftward", "rightward"]  # within the margin of "right"
    assert "unlike" not in {word for words in near.values() for word in words}


def test_neighbours_of_another_word_are_not_taken() -> None:
    """A candidate that lies clearly nearer to another word of the captions stands for that one."""
    config = CONFIG.model_copy(update={"nearness": -1.0, "neighbours": 20})
    near = neighbours(CAPTIONS, sorted(ANGLE), Circle(), config)
    assert "jogs" not in near["walks"]
    assert near["runs"] == ["jogs", "sprints"]
    assert neighbours(CAPTIONS, sorted(ANGLE), Circle(), CONFIG.model_copy(update={"neighbours": 1}))[
        "walks"
    ] == ["strolls"]


def test_a_rewording_is_a_function_of_caption_and_number() -> None:
    near = {"walks": ["strolls", "wanders"], "left": ["leftward"]}
    one = [reword(CAPTIONS[0], near, number, CONFIG) for number in range(200)]
    assert one == [reword(CAPTIONS[0], near, number, CONFIG) for number in range(200)]
    words = [word for said in one for word in said.rstrip(".").split()]
    assert set(words) == {"someone", "walks", "strolls", "wanders", "left", "leftward"}
    # 200 draws each: four standard errors are 0.14 (replace) and 0.11 (drop).
    assert np.mean(["walks" not in said for said in one]) == pytest.approx(0.6, abs=0.14)  # or dropped
    assert np.mean(["someone" not in said for said in one]) == pytest.approx(0.2, abs=0.12)
    assert np.mean([said.endswith(".") for said in one]) == pytest.approx(0.5, abs=0.15)
    assert not any("  " in said or " ." in said or said != said.strip() for said in one)


def test_a_caption_of_nothing_but_dropped_words_stays() -> None:
    config = CONFIG.model_copy(update={"drop": 0.99})
    assert {reword("walks.", {}, number, config) for number in range(30)} >= {"walks."}
    assert all(reword("walks.", {}, number, config) for number in range(30))


def test_whole_words_of_three_kinds_of_vocabulary() -> None:
    assert whole_words(["[CLS]", "walk", "##ing", "an", "Walk", "it's", "stroll", "12"]) == ["stroll", "walk"]
    assert whole_words(["Ġwalk", "walk", "ing", "Ġ12", "Ġstroll"]) == ["stroll", "walk"]
    assert whole_words(["walk</w>", "walk", "ing", "stroll</w>"]) == ["stroll", "walk"]


@pytest.fixture
def made(tmp_path: Path) -> tuple[Rewordings, TextCache]:
    text = build_with_encoder(tmp_path / "text", CAPTIONS, Circle(), progress=False)
    made = Rewordings.build(
        tmp_path / "other", CAPTIONS, Circle(), sorted(ANGLE), CONFIG.model_copy(update={"share": 0.5}),
        progress=False,
    )  # fmt: skip
    return made, text


def test_reading_takes_rewordings_as_often_as_asked(made: tuple[Rewordings, TextCache]) -> None:
    rewordings, text = made
    draws = np.linspace(0, 1, 40, endpoint=False)
    captions = [CAPTIONS[i % 4] for i in range(40)]
    said = rewordings.of(captions, draws)
    assert [other is not None for other in said] == [draw < 0.5 for draw in draws]
    tokens, mask, sentence = rewordings.read(captions, draws, text)
    for i, (caption, other) in enumerate(zip(captions, said, strict=True)):
        alone = Circle().encode([other or caption])
        count = int(mask[i].sum())
        assert mask[i, :count].all() and count == alone.tokens.shape[1]
        np.testing.assert_allclose(tokens[i, :count], alone.tokens[0], atol=1e-3)  # kept as halves
        assert (tokens[i, count:] == 0).all()
        np.testing.assert_allclose(sentence[i], alone.sentence[0], atol=1e-6)


def test_they_travel_to_loader_workers_and_refuse_other_captions(made: tuple[Rewordings, TextCache]) -> None:
    rewordings, text = made
    other = pickle.loads(pickle.dumps(rewordings))
    draws = np.array([0.1, 0.9])
    for one, again in zip(
        rewordings.read(CAPTIONS[:2], draws, text), other.read(CAPTIONS[:2], draws, text), strict=True
    ):
        np.testing.assert_array_equal(one, again)
    with pytest.raises(UserError, match="no rewordings of 'someone flies"):
        rewordings.of(["someone flies."], draws[:1])
