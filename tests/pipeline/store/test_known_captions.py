"""What a model says of captions that it does not know, and of motions that show something else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.store.known_captions import (
    FALSE_ALARMS,
    KnownCaptions,
    load_known,
    representatives,
    save_known,
)

TRAINED = (
    "a person waves with the right hand",
    "a man greets by waving both hands",
    "someone walks straight ahead fast",
    "a figure raises the right arm",
    "the person does a left kick once",
    "a woman jumps up twice",
)
WAVING = "a person is waving the left hand"
VIOLIN = "a person plays the violin"
HELD_OUT = ("somebody is waving their left hand", "someone strolls ahead slowly", "lifts the right arm high")
NONE = np.zeros((0, 8), np.float32)


def unit(count: int, width: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(size=(count, width))
    return (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype(np.float32)


def test_representatives_leave_no_caption_far() -> None:
    vectors = unit(200, 3, 1)
    texts = [f"caption {k:03d}" for k in range(200)]
    made = representatives(texts, vectors, vectors[:0], 12)
    distances = np.sqrt(np.maximum(0, 2 - 2 * vectors.astype(np.float64) @ made.embeddings.T))
    radius = distances.min(axis=1).max()
    # Gonzalez: with the farthest caption, 13 lie pairwise `radius` apart; smaller balls need more than 12.
    chosen = made.embeddings.astype(np.float64)
    apart = np.sqrt(np.maximum(0, 2 - 2 * chosen @ chosen.T))[np.triu_indices(12, 1)].min()
    assert apart >= radius - 1e-6
    assert len(set(made.captions)) == 12
    shuffled = np.random.default_rng(2).permutation(200)
    again = representatives([texts[k] for k in shuffled], vectors[shuffled], vectors[:0], 12)
    assert again.captions == made.captions, "the choice hangs on the captions, not on their order"


def test_fewer_captions_than_are_wanted_all_stand_for_themselves() -> None:
    made = representatives(["b", "a"], unit(2, 4, 3), unit(0, 4, 3), 12)
    assert sorted(made.captions) == ["a", "b"]
    none = np.zeros((0, 4), np.float32)
    assert representatives([], none, none).captions == ()


def test_false_alarms_on_validation_captions_are_as_many_as_stated() -> None:
    held_out = unit(5000, 8, 5)
    known = representatives([f"{k}" for k in range(300)], unit(300, 8, 4), held_out, 64)
    assert np.mean([known.is_far(one) for one in held_out]) == pytest.approx(FALSE_ALARMS, abs=0.003)
    assert not KnownCaptions((), NONE).is_far(held_out[0]), "a model without faces calls no face unknown"


def test_a_known_caption_is_known_where_validation_repeats_the_training() -> None:
    """Faces have few captions: all of them are known, and what is kept of them is rounded."""
    vectors = np.random.default_rng(0).normal(size=(8, 384)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    known = representatives(
        [str(k) for k in range(8)], vectors, vectors.astype(np.float16).astype(np.float32)
    )
    assert not any(known.is_far(embedding) for embedding in vectors)
    assert known.is_far(-vectors[0])


def test_other_words_are_known_and_other_things_are_not() -> None:
    encoder = load_text_encoder("minilm")
    known = representatives(TRAINED, encoder.encode(TRAINED).sentence, encoder.encode(HELD_OUT).sentence)
    assert not known.is_far(encoder.encode([WAVING]).sentence[0])
    for text in ("a person plays the violin", "a man rides a bicycle", "stock prices fell sharply"):
        assert known.is_far(encoder.encode([text]).sentence[0])
    nearest = known.nearest(encoder.encode(["jump two times"]).sentence[0])
    assert nearest[0] == TRAINED[-1] and len(nearest) == 3


def test_files_come_back(tmp_path: Path) -> None:
    body = KnownCaptions(("a", "b"), unit(2, 8, 4), (0.0, 0.25, 0.5))
    save_known(tmp_path, body, KnownCaptions((), NONE), ("walk", "kick"))
    texts, found = load_known(tmp_path)
    assert found["body"].captions == ("a", "b") and found["face"].captions == ()
    assert texts.actions == ("kick", "walk")
    assert found["body"].distances == body.distances
    np.testing.assert_allclose(found["body"].embeddings, body.embeddings, atol=2**-11)
    assert load_known(tmp_path / "none")[1] == {}


def test_a_run_of_clips_with_a_truth_knows_their_actions(small_run: Any) -> None:
    """A caption that names one of them is known by that, whatever else it says; refused where it is none."""
    texts, known = load_known(small_run.folder / "stages" / "text")
    assert {"walk", "wave", "kick"} <= set(texts.actions) and known["body"].distances
    bundle = MotionModel(small_run.folder).bundle
    for caption in ("an angry customer kicks the fence", "kick nine times", "walk, then wave"):
        assert bundle.unknown_captions([caption]) == [], caption
    for caption in ("nobody kicks", "kick, jump and wave", "he plays the violin"):
        (found,) = bundle.unknown_captions([caption, caption])
        assert found.caption == caption and len(found.nearest) == 3
    (found,) = bundle.unknown_captions(["a person does not wave the left hand"])
    assert len(found.nearest) == 3 and not any("wav" in one for one in found.nearest)
    for caption in ("ein Mann läuft vorwärts", "una persona saluda a su amigo", "人が歩く", "iemand zwaait"):
        (found,) = bundle.unknown_captions([caption])
        assert not found.english and not found.nearest and "reads English" in str(found)
    assert bundle.find_mismatches([]) == []


def test_generate_says_so_from_a_run_and_from_an_export(small_run: Any, call: Any, tmp_path: Path) -> None:
    words = ["a person walks forward", VIOLIN]
    said = call("generate", small_run.folder, *words, "-o", tmp_path / "run").err
    assert said.count(" is unlike") == 1 and f"'{VIOLIN}' is unlike" in said
    assert (tmp_path / "run" / "index.html").read_text().count(f"'{VIOLIN}' is unlike") == 1
    call("export", small_run.folder, "-o", tmp_path / "model")
    said = call("generate", tmp_path / "model", *words, "-o", tmp_path / "model-out", "-f", "npz").err
    assert said.count(" is unlike") == 1
    model = MotionModel.from_pretrained(tmp_path / "model", device="cpu")
    with pytest.warns(UserWarning, match="violin.*The nearest it knows"):
        model.generate(words, face=["a person looks happy"] * 2 if model.bundle.faces else None)


def test_a_motion_without_what_is_said_is_noted(
    small_run: Any, call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = iter([None, "the motion shows no punch"] * 3)
    monkeypatch.setattr("motionloom.pipeline.inference.checks.find_mismatch", lambda *_: next(looked))
    asked = ["a person punches", "--samples", 2, "--seconds", 1.5]
    said = call("generate", small_run.folder, *asked, "-o", tmp_path).err
    assert "note: 'a person punches': " in said and "in 1 of 2 " in said
    page = (tmp_path / "index.html").read_text()
    assert page.count("'a person punches': by its joints the motion shows no punch") == 1
    model = MotionModel.from_pretrained(small_run.folder, device="cpu")
    with pytest.warns(UserWarning, match="in 1 of 2"):
        model.generate(["a person punches"] * 2, seconds=1.5)
