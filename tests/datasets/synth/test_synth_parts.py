"""Parts of the synthetic source: captions, hands, faces, plain dances, maths."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.actions.dances import measure_dance
from motionloom.datasets.actions.hands import HANDS, hand_shape
from motionloom.datasets.actions.signals import signals_of, tempo
from motionloom.datasets.motion.body.expressions import BASIS, FACES, emotion_of
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.synth.actions.pose import OFFSETS, SKELETON
from motionloom.datasets.synth.actions.truth import ACTIONS, BASIC, Span, Truth, draw
from motionloom.datasets.synth.captions import Wordings, body_captions, face_captions, words
from motionloom.datasets.synth.dances import dance
from motionloom.datasets.synth.hands_and_face import express, shape_hand

TIMES = {1: "once|one time", 2: "twice|two|2", 3: "three|3|thrice", 4: "four|4", 5: "five|5"}


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("wordings", ["few", "many", "everyday"])
def test_every_caption_says_what_decides_the_motion(action: str, wordings: Wordings) -> None:
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = draw(action, rng)
        texts = body_captions(truth, rng, wordings=wordings)
        assert len(texts) == len(set(texts)) >= 2
        for number, text in enumerate(texts):
            assert not re.search(r"[{}|]|None|  ", text), text
            if wordings == "everyday" and number == 2:
                continue  # leaves most unsaid
            for part in truth.parts or ():
                assert part.side in (None, "both") or part.side in text, text
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
            if wordings == "few":
                assert truth.direction != "clockwise" or "clockwise" in text.replace(",", "").split()
                assert truth.direction != "counterclockwise" or "counter" in text
                assert truth.speed != "slowly" or "slow" in text
                assert truth.speed != "quickly" or "quick" in text or "fast" in text
                assert not truth.bpm or str(truth.bpm) in text
        for text in face_captions(truth, rng, wordings="many"):
            assert not re.search(r"\b(man|woman|he|she|boy|girl)\b", text), text


def test_captions_without_hands_do_not_speak_of_fingers() -> None:
    for seed in range(200):
        rng = np.random.default_rng(seed)
        truth = draw(BASIC[seed % len(BASIC)], rng)
        for text in body_captions(truth, rng, hands=False):
            assert not {"fingers", "finger", "pinching", "pointing", "fists"} & set(text.split())


@pytest.mark.parametrize("shape", HANDS)
@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_hand_shapes_read_back(shape: str, fps: float) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        t = np.arange(int(2.5 * fps)) / fps
        local = np.tile(np.eye(3), (len(t), 52, 1, 1))
        local[:, 22:37] = shape_hand(shape, t, rng)
        joints, _ = forward_kinematics(local, np.zeros((len(t), 3)), OFFSETS, SKELETON.parents)
        noisy = joints + rng.normal(0, 0.001, joints.shape)
        assert hand_shape(joints, 0, fps) == shape
        assert hand_shape(noisy, 0, fps) == shape
        np.testing.assert_allclose(np.linalg.det(local[:, 22:37]), 1.0, atol=1e-9)


def test_face_basis_is_orthonormal_and_values_have_unit_order() -> None:
    np.testing.assert_allclose(BASIS.T @ BASIS, np.eye(8), atol=1e-12)
    t = np.arange(120) / 30
    values = []
    for seed in range(60):
        emotion = FACES[seed % 5]
        x = express(emotion, t, np.random.default_rng(seed))
        assert x.shape == (120, 50)
        assert emotion_of(x) == emotion
        values.append(x)
    assert 0.2 < np.std(values) < 1.5
    assert np.abs(np.diff(np.stack(values), axis=1)).max() < 2.5


def test_face_captions_are_about_the_person_of_the_body_captions() -> None:
    truth = Truth("jump", face="neutral")
    people = {
        (): {"a person", "a man", "a woman", "someone", "the person", "a figure"},
        ("someone jumps",): {"a person", "a man", "a woman", "someone", "the person", "a figure"},
        ("a woman jumps", "a figure jumps"): {"a person", "a woman", "someone", "the person", "a figure"},
        ("a man jumps", "a woman jumps"): {"a person", "someone", "the person", "a figure"},
    }
    for body, allowed in people.items():
        rng = np.random.default_rng(0)
        texts = [text for _ in range(40) for text in face_captions(truth, rng, body=body)]
        said = {who for who in people[()] if any(text.startswith(f"{who} ") for text in texts)}
        assert said == allowed


def test_dances_without_music_have_their_tempo_and_style() -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = draw("dance", rng)
        joints = dance(truth, Span(4.0, 6.0), 60.0, rng).solve()
        assert abs(tempo(signals_of(joints, 60.0)) - (truth.bpm or 0)) < 4
        assert measure_dance(joints, 60.0).style == truth.style


KEPT = Path(__file__).resolve().parents[3] / "benchmarks" / "synthetic_wordings.json"


def test_sentences_kept_for_measuring_are_never_made() -> None:
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    assert set(kept["actions"]) <= set(words().many.actions)
    made = " ".join(phrase for phrases in words().many.actions.values() for phrase in phrases)
    for phrase in (phrase for phrases in kept["actions"].values() for phrase in phrases):
        new = spoken(phrase) - spoken(made)
        assert new, f"'{phrase}' has no word that training has not"


def spoken(text: str) -> set[str]:
    """Words without their endings, so that "strolls" is no other word than "stroll"."""
    return {re.sub(r"(ing|es|s|e)$", "", w) for w in re.findall(r"[a-z]{3,}", re.sub(r"{.}", "", text))}
