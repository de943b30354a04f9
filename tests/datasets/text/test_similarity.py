"""Which captions mean the same: always one encoder's word, beside any text encoder."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.text import build as build_module
from motionloom.datasets.text.build import build_text_cache
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText

CAPTIONS = [f"caption {i}" for i in range(40)]


class Made:
    """An encoder of `dim` values that are a function of its name and the caption."""

    def __init__(self, name: str, dim: int) -> None:
        self.name, self.dim = name, dim

    def encode(self, captions: Sequence[str]) -> EncodedText:
        seeds = [sum(map(ord, self.name + text)) for text in captions]
        sentence = np.stack([np.random.default_rng(seed).standard_normal(self.dim) for seed in seeds])
        sentence = (sentence / np.linalg.norm(sentence, axis=1, keepdims=True)).astype(np.float32)
        return EncodedText(sentence, np.repeat(sentence[:, None], 3, 1), np.ones((len(seeds), 3), dtype=bool))


WIDTHS = {"clip": 6, "minilm": 4, "other": 5}


@pytest.fixture(autouse=True)
def _encoders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        build_module, "load_text_encoder", lambda spec, device="cpu": Made(spec, WIDTHS[spec])
    )


def build(
    folder: Path, encoder: str, similarity: str | None, captions: Sequence[str] = CAPTIONS
) -> TextCache:
    return build_text_cache(folder, captions, encoder, progress=False, similarity=similarity)


def wanted(name: str, captions: Sequence[str]) -> np.ndarray:
    return Made(name, WIDTHS[name]).encode(captions).sentence


def test_similarity_is_the_named_encoders(tmp_path: Path) -> None:
    asked = CAPTIONS[30:] + CAPTIONS[:5]
    cache = build(tmp_path, "clip", "minilm")
    for one in (cache, pickle.loads(pickle.dumps(cache)), TextCache.open(tmp_path)):
        np.testing.assert_array_equal(one.sentence(asked), wanted("clip", asked))
        np.testing.assert_array_equal(one.similarity(asked), wanted("minilm", asked))
        assert one.tokens(asked)[0].shape == (15, 3, 6)


def test_nothing_more_is_stored_for_one_encoder(tmp_path: Path) -> None:
    for similarity in ("minilm", None):
        cache = build(tmp_path / str(similarity), "minilm", similarity)
        np.testing.assert_array_equal(cache.similarity(CAPTIONS), wanted("minilm", CAPTIONS))
        assert not (tmp_path / str(similarity) / "similarity").exists()


def test_a_changed_encoder_or_caption_set_is_followed(tmp_path: Path) -> None:
    build(tmp_path, "clip", "minilm", CAPTIONS[:10])
    more = build(tmp_path, "clip", "minilm")
    np.testing.assert_array_equal(more.similarity(CAPTIONS), wanted("minilm", CAPTIONS))
    np.testing.assert_array_equal(
        build(tmp_path, "clip", "other").similarity(CAPTIONS), wanted("other", CAPTIONS)
    )
    np.testing.assert_array_equal(
        build(tmp_path, "minilm", "minilm").similarity(CAPTIONS), wanted("minilm", CAPTIONS)
    )
