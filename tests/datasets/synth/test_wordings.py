"""Captions in many words: each says what decides the motion, and those kept for measuring are among none."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.datasets.synth.grammar import body_captions
from motionloom.datasets.synth.truth import ACTIONS, FACES, HANDS, Truth, draw
from motionloom.datasets.synth.wordings import many_body_captions, many_face_captions, words

KEPT = Path(__file__).resolve().parents[3] / "benchmarks" / "synthetic_wordings.json"
TIMES = {1: "once|one time", 2: "twice|two|2", 3: "three|3|thrice", 4: "four|4", 5: "five|5"}


def truths(count: int) -> list[Truth]:
    rng = np.random.default_rng(5)
    return [draw(action, rng, HANDS[1:]) for action in ACTIONS for _ in range(count)]


def test_every_sentence_says_what_decides_the_motion() -> None:
    rng = np.random.default_rng(6)
    for truth in truths(40):
        for text in many_body_captions(truth, rng, 4, hands=True):
            assert not re.search(r"[{}|]|None|  ", text), text
            sides = set(re.findall(r"\b(left|right)\b", text))
            if truth.side in ("left", "right"):
                assert truth.side in sides, text
            if truth.action == "turn":
                assert truth.direction in sides, text
            if truth.count and truth.action != "dance":
                assert re.search(TIMES[truth.count], text), text
            for name, shape in (("left", truth.left_hand), ("right", truth.right_hand)):
                implied = {"punch": "fist", "wave": "spread"}.get(truth.action) == shape
                if shape != "relaxed" and not implied:
                    assert re.search(rf"{name}|both|each", text), text
        for text in many_face_captions(truth, rng):
            assert not re.search(r"\b(man|woman|he|she|boy|girl)\b", text), text


def test_there_are_many_and_they_come_again_with_the_seed() -> None:
    truth = Truth("wave", side="left")
    many, few = ({t for s in range(200) for t in make(s)} for make in (
        lambda s: many_body_captions(truth, np.random.default_rng(s), 3, hands=True),
        lambda s: body_captions(truth, np.random.default_rng(s), 3, hands=True),
    ))  # fmt: skip
    assert len(many) > 5 * len(few)
    again = [many_body_captions(truth, np.random.default_rng(3), 3, hands=True) for _ in range(2)]
    assert again[0] == again[1] and len(set(again[0])) == 3


@pytest.mark.parametrize("face", FACES)
def test_verbs_are_written_right(face: str) -> None:
    rng = np.random.default_rng(1)
    said = {text for _ in range(300) for text in many_face_captions(Truth("wave", face=face), rng)}
    assert not [text for text in said if re.search(r"\b(haves|bes|dos|gos|looking at|be)\b", text)]


def test_sentences_kept_for_measuring_are_never_made() -> None:
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    assert set(kept["actions"]) <= set(words().actions)
    made = " ".join(phrase for phrases in words().actions.values() for phrase in phrases)
    for phrase in (phrase for phrases in kept["actions"].values() for phrase in phrases):
        new = spoken(phrase) - spoken(made)
        assert new, f"'{phrase}' has no word that training has not"


def spoken(text: str) -> set[str]:
    """Words without their endings, so that "strolls" is no other word than "stroll"."""
    return {re.sub(r"(ing|es|s|e)$", "", w) for w in re.findall(r"[a-z]{3,}", re.sub(r"{.}", "", text))}


def test_motions_are_those_of_few_wordings() -> None:
    few, many = (
        make_clip(1, SynthConfig.parse({"clips": 4, "seed": 3, "wordings": wordings}, "test"))
        for wordings in ("few", "many")
    )
    np.testing.assert_array_equal(few.joints, many.joints)
    assert few.truth == many.truth and few.texts != many.texts
    assert "wordings" not in SynthConfig(clips=4).dump()
    assert SynthConfig(clips=4, wordings="many").dump()["wordings"] == "many"
