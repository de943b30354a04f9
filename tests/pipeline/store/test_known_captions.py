"""What a model says of captions that it does not know."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.datasets.text.encoder import TextEncoder, load_text_encoder
from motionloom.datasets.text.words import HeardWords, words_of
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.store.known_captions import (
    AS_NEAR,
    FAR,
    KNOWN_FILES,
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
OTHER_WORDS = (
    "somebody is waving their left hand",
    "someone strolls ahead slowly",
    "lifts the right arm high",
)


def words(encoder: TextEncoder) -> HeardWords:
    """Of a training whose words were not kept."""
    return HeardWords(
        frozenset(), lambda texts: encoder.encode(texts).sentence, lambda _: np.ones(1, np.int64)
    )


ELSEWHERE = ("a person plays the violin", "a man rides a bicycle", "stock prices fell sharply")


def unit(count: int, width: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(size=(count, width))
    return (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype(np.float32)


def test_representatives_leave_no_caption_far() -> None:
    vectors = unit(200, 3, 1)
    texts = [f"caption {k:03d}" for k in range(200)]
    made = representatives(texts, vectors, 12)
    distances = np.sqrt(np.maximum(0, 2 - 2 * vectors.astype(np.float64) @ made.embeddings.T))
    radius = distances.min(axis=1).max()
    # Gonzalez: with the farthest caption, 13 lie pairwise `radius` apart; smaller balls need more than 12.
    chosen = made.embeddings.astype(np.float64)
    apart = np.sqrt(np.maximum(0, 2 - 2 * chosen @ chosen.T))[np.triu_indices(12, 1)].min()
    assert apart >= radius - 1e-6
    assert len(set(made.captions)) == 12
    shuffled = np.random.default_rng(2).permutation(200)
    again = representatives([texts[k] for k in shuffled], vectors[shuffled], 12)
    assert again.captions == made.captions, "the choice hangs on the captions, not on their order"


def test_fewer_captions_than_are_wanted_all_stand_for_themselves() -> None:
    made = representatives(["b", "a"], unit(2, 4, 3), 12)
    assert sorted(made.captions) == ["a", "b"]
    assert representatives([], np.zeros((0, 4), np.float32)).captions == ()


def test_other_words_are_known_and_other_things_are_not() -> None:
    encoder = load_text_encoder("minilm")
    known = KnownCaptions(TRAINED, encoder.encode(TRAINED).sentence)
    assert known.unknown(OTHER_WORDS, words(encoder)) == []
    found = known.unknown(ELSEWHERE, words(encoder))
    assert [one.caption for one in found] == list(ELSEWHERE)
    assert "a man rides a bicycle" in str(found[1]) and found[1].nearest[0] in str(found[1])


def test_a_caption_that_the_model_reads_as_something_else_is_unknown() -> None:
    encoder = load_text_encoder("minilm")
    known = KnownCaptions(TRAINED, encoder.encode(TRAINED).sentence)
    punch, walk = np.eye(2, dtype=np.float32)

    def read(texts: Sequence[str]) -> np.ndarray:
        return np.stack([walk if text == said else punch for text in texts])

    said = "a person waves with the left hand"
    assert not known.unknown([said], words(encoder))
    assert known.unknown([said], words(encoder), read)


@pytest.mark.parametrize(
    "said, known",
    [
        ("the boxer does a left kick once", True),  # who moves decides nothing
        ("a woman jumps twice", True),
        ("a woman is jumping 2 times", True),
        ("the person kicks twice", False),  # a number that only another action had
        ("a person waves with the right hand, then jumps twice", False),
        ("the person doesn't kick", False),
    ],
)
def test_words_decide_beside_what_training_said_with_them(said: str, known: bool) -> None:
    """A model that takes captions of one action for the same."""
    encoder, actions = load_text_encoder("minilm"), ("wav", "walk", "rais", "kick", "jump")

    def read(texts: Sequence[str]) -> NDArray[np.float32]:
        found = [[float(action in text) for action in actions] for text in texts]
        return np.asarray(found, np.float32) / np.linalg.norm(found, axis=1, keepdims=True)

    def embedded(texts: Sequence[str]) -> NDArray[np.float32]:
        return encoder.encode(texts).sentence

    heard = HeardWords(words_of(TRAINED), embedded, lambda texts: np.ones(len(texts), np.int64))
    trained = KnownCaptions(TRAINED, embedded(TRAINED), heard.words)
    assert (trained.unknown([said], heard, read) == []) is known


ACTS = (("wave",), ("wave",), ("walk",), ("raise",), ("kick",), ("jump",))


@pytest.mark.parametrize(
    ("said", "acts"),
    [
        ("somebody is waving their left hand", [("wave",)]),
        ("lifts the right arm high", [("raise",)]),
        ("a woman jumps up, then greets by waving both hands", [("jump", "wave")]),
        ("a left kick, and after that someone walks ahead", [("kick", "walk")]),
    ],
)
def test_the_nearest_say_what_a_caption_asks_for(said: str, acts: list[tuple[str, ...]]) -> None:
    """And one that puts an action after another is looked at part by part."""
    embedded = words(load_text_encoder("minilm")).encode
    assert KnownCaptions(TRAINED, embedded(TRAINED), acts=ACTS).asked(said, embedded) == acts
    assert KnownCaptions(TRAINED, embedded(TRAINED)).asked(said, embedded) == []
    turns = KnownCaptions(TRAINED, embedded(TRAINED), acts=(("wave", "kick"),) * len(TRAINED))
    assert turns.asked("wave, then kick", embedded) == [("wave", "kick")], "by its words"
    assert turns.asked("a greeting, then a boot", embedded) == [], "which knows no action alone"
    partly = KnownCaptions(TRAINED, embedded(TRAINED), acts=((),) * len(TRAINED))
    assert partly.asked(said, embedded) == [], "of captions of which it is not known"


def test_of_captions_that_the_model_reads_alike_none_is_left_out() -> None:
    embedded = words(load_text_encoder("minilm")).encode
    known = KnownCaptions(TRAINED, embedded(TRAINED), acts=ACTS)

    def read(texts: Sequence[str]) -> NDArray[np.float32]:
        """A model to which all captions but those of walks are the same."""
        return np.stack([np.eye(2, dtype=np.float32)[int("walk" in text)] for text in texts])

    assert known.asked("someone walks ahead", embedded, read) == [("walk",)]
    cosines = np.sort(embedded(TRAINED) @ embedded(["a wave"])[0])[::-1]
    alike = int((cosines[:3] >= cosines[0] - AS_NEAR).sum())
    assert 1 <= len(known.asked("a wave", embedded, read)) <= alike


@pytest.mark.parametrize(
    ("said", "known"),
    [
        ("the person does a left kick once on the meadow", True),
        ("the person does a left kick nine times", False),
        ("the person never does a left kick", False),
        ("the person knits on the meadow", False),
    ],
)
def test_words_never_heard_change_nothing_beside_a_caption_that_is_very_near(said: str, known: bool) -> None:
    encoder = load_text_encoder("minilm")

    def read(texts: Sequence[str]) -> NDArray[np.float32]:
        return np.stack([np.eye(2, dtype=np.float32)[int("kick" in text)] for text in texts])

    def embedded(texts: Sequence[str]) -> NDArray[np.float32]:
        return encoder.encode(texts).sentence

    heard = HeardWords(words_of(TRAINED), embedded, lambda texts: np.ones(len(texts), np.int64))
    assert heard.unheard(said)
    trained = KnownCaptions(TRAINED, embedded(TRAINED), heard.words)
    assert (trained.unknown([said], heard, read) == []) is known
    assert trained.unknown([said], heard), "by sentences alone nothing is that near"


@pytest.mark.parametrize(
    ("said", "known"),
    [
        ("an angry customer kicks the fence", True),  # words never heard, beside one that names the action
        ("kick nine times", True),  # how often is seen in the joints
        ("nobody kicks", False),
        ("never ever kick", False),
        ("jump like nobody is watching", True),
        ("kick, jump and wave", False),  # more than two actions
        ("a man waves with his right hand and jumps up twice", True),
        ("turn around", False),  # nothing in this training turns
        ("walk up the stairs", False),  # the word, and another action
        ("he plays hopscotch", False),
    ],
)
def test_a_caption_that_names_an_action_is_known_unless_it_means_another(said: str, known: bool) -> None:
    """Where it is known what the motions of the training do."""
    embedded = words(load_text_encoder("minilm")).encode
    heard = HeardWords(words_of(TRAINED), embedded, lambda texts: np.ones(len(texts), np.int64))
    trained = KnownCaptions(TRAINED, embedded(TRAINED), heard.words, ACTS)
    assert (trained.unknown([said], heard) == []) is known


def test_a_number_counts_beside_what_was_said_with_it() -> None:
    """Where it is known what captions ask for: two jumps say nothing of two kicks."""
    embedded = words(load_text_encoder("minilm")).encode
    heard = HeardWords(words_of(TRAINED), embedded, lambda texts: np.ones(len(texts), np.int64))
    same = lambda texts: np.ones((len(texts), 1), np.float32)  # noqa: E731
    for acts, known in (((), True), (ACTS, False)):
        trained = KnownCaptions(TRAINED, embedded(TRAINED), heard.words, acts)
        assert (
            trained.unknown(["the person lashes out twice with the left foot"], heard, same) == []
        ) is known


def test_files_come_back(tmp_path: Path) -> None:
    heard = frozenset({"b", "a"})
    body = KnownCaptions(("a", "b"), unit(2, 8, 4), heard, (("wave",), ("walk", "kick")))
    face = KnownCaptions((), np.zeros((0, 8), np.float32))
    save_known(tmp_path, body, face)
    found = load_known(tmp_path)
    assert found["body"].captions == ("a", "b") and found["face"].captions == ()
    assert found["body"].words == heard and found["body"].acts == body.acts
    np.testing.assert_allclose(found["body"].embeddings, body.embeddings, atol=2**-11)
    assert (
        found["face"].unknown(
            ["x"], HeardWords(heard, lambda _: unit(1, 8, 5), lambda _: np.ones(1, np.int64))
        )
        == []
    ), "a model without faces calls no face unknown"
    assert load_known(tmp_path / "none") == {}


@pytest.mark.parametrize(
    "acts", [(("wave",),), (("wave",), ("fly\x1b[31m",)), (("wave",), ("wave", "walk", "kick"))]
)
def test_acts_that_cannot_be_are_refused(tmp_path: Path, acts: tuple[tuple[str, ...], ...]) -> None:
    body = KnownCaptions(("a", "b"), unit(2, 8, 4), acts=acts)
    save_known(tmp_path, body, KnownCaptions((), np.zeros((0, 8), np.float32)))
    with pytest.raises(UserError, match=r"known\.json: acts does not go with body"):
        load_known(tmp_path)


@pytest.mark.parametrize("damage", ["cut", "other"])
def test_damaged_files_are_named(tmp_path: Path, damage: str) -> None:
    save_known(tmp_path, KnownCaptions(("a",), unit(1, 8, 4)), KnownCaptions(("b",), unit(1, 8, 6)))
    path = tmp_path / KNOWN_FILES[1]
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:40])
    else:
        save_known(tmp_path / "x", KnownCaptions(("a", "c"), unit(2, 8, 4)), KnownCaptions((), unit(0, 8, 6)))
        shutil.copyfile(tmp_path / "x" / KNOWN_FILES[1], path)
    with pytest.raises(UserError, match=r"known\.safetensors"):
        load_known(tmp_path)


def test_a_run_of_synthetic_clips_knows_what_its_captions_ask_for(small_run: Any) -> None:
    known = load_known(small_run.folder / "stages" / "text")["body"]
    assert known.acts and all(known.acts)
    said = dict(zip(known.captions, known.acts, strict=True))
    assert all(acts == ("wave",) for text, acts in said.items() if " waves" in text and " and " not in text)


def test_generate_says_so_from_a_run_and_from_an_export(small_run: Any, call: Any, tmp_path: Path) -> None:
    words = ["a person walks forward", "a person plays the violin"]
    said = call("generate", small_run.folder, *words, "-o", tmp_path / "run").err
    assert said.count(" is unlike") == 1 and "'a person plays the violin' is unlike" in said
    assert (tmp_path / "run" / "index.html").read_text().count("'a person plays the violin' is unlike") == 1
    call("export", small_run.folder, "-o", tmp_path / "model")
    said = call("generate", tmp_path / "model", *words, "-o", tmp_path / "model-out", "-f", "npz").err
    assert said.count(" is unlike") == 1
    model = MotionModel.from_pretrained(tmp_path / "model", device="cpu")
    with pytest.warns(UserWarning, match="violin.*The nearest it knows"):
        model.generate(words, face=["a person looks happy"] * 2 if model.bundle.faces else None)
    assert 0 < FAR < 1


def test_a_motion_without_what_is_said_is_noted(
    small_run: Any, call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = iter([None, "the motion shows no punch"] * 2)
    monkeypatch.setattr("motionloom.datasets.check.claims.doubt", lambda *_: next(looked))
    asked = ["a person punches", "--samples", 2, "--seconds", 1.5]
    said = call("generate", small_run.folder, *asked, "-o", tmp_path).err
    assert "note: 'a person punches': by its joints the motion shows no punch in 1 of 2 motions; try" in said
    assert "shows no punch in 1 of 2" in (tmp_path / "index.html").read_text()
    model = MotionModel.from_pretrained(small_run.folder, device="cpu")
    with pytest.warns(UserWarning, match="shows no punch in 1 of 2"):
        model.generate(["a person punches"] * 2, seconds=1.5)


def test_a_stream_says_so_when_the_captions_turn_comes(small_run: Any, call: Any, tmp_path: Path) -> None:
    """By the command, from Python, and of a caption that comes on the way; each caption once."""
    known, strange = "a person walks forward", "a person plays the violin"
    options = ["--stream", "--seconds", "0.8", "-o", tmp_path / "made.jsonl"]
    said = call("generate", small_run.folder, known, strange, known, strange, *options).err
    assert said.count("note: ") == 1 and f"note: '{strange}' is unlike all captions" in said
    model = MotionModel.from_pretrained(small_run.folder, device="cpu")
    stream = model.stream([(known, 0.8), (strange, 0.8), (known, 0.8)], seed=1)
    with pytest.warns(UserWarning, match="violin.*The nearest it knows") as warned:
        list(stream)
    assert len(warned) == 1 and warned[0].filename == __file__
    stream = model.stream(known, seed=1)
    next(stream)
    stream.say("stock prices fell sharply", seconds=0.4)
    with pytest.warns(UserWarning, match="stock prices"):
        for chunk in stream:
            if chunk.caption != known:
                break
