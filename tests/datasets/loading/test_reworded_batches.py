"""Rewordings in caption batches: drawn by clip and turn, so the ranks' shares are the one batch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from motionloom.datasets.loading.batches import CaptionBatch, CaptionBatches
from motionloom.datasets.loading.statistics import compute
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText
from motionloom.datasets.text.reword import RewordConfig, Rewordings


class Letters:
    """One token a letter, its code; the sentence is their mean direction."""

    dim = 2

    def __init__(self, name: str = "letters") -> None:
        self.name = name

    def encode(self, captions: Sequence[str]) -> EncodedText:
        tokens = np.zeros((len(captions), max(map(len, captions)), 2), dtype=np.float32)
        for row, caption in zip(tokens, captions, strict=True):
            row[: len(caption), 0] = [ord(letter) / 128 for letter in caption]
            row[: len(caption), 1] = 1
        sentence = tokens.sum(1) / np.linalg.norm(tokens.sum(1), axis=1, keepdims=True)
        return EncodedText(sentence, tokens, tokens[..., 1] > 0)


@pytest.fixture(scope="module")
def train(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> ShardDataset:
    root = tmp_path_factory.mktemp("data")
    made.write(root, count=100)
    return ShardDataset.open(root, "train")


@pytest.fixture(scope="module")
def captions(train: ShardDataset) -> set[str]:
    return {caption.text for i in range(len(train)) for caption in train.texts(i)}


@pytest.fixture(scope="module")
def text(captions: set[str], tmp_path_factory: pytest.TempPathFactory) -> TextCache:
    return build_with_encoder(tmp_path_factory.mktemp("text"), captions, Letters(), progress=False)


def rewordings(folder: Path, captions: set[str], encoder: Letters, share: float) -> Rewordings:
    config = RewordConfig(share=share, drop=0.4, count=3)
    return Rewordings.build(folder, captions, encoder, [], config, progress=False)


def batches(
    train: ShardDataset, text: TextCache, made: Rewordings | None, rank: int = 0, world: int = 1
) -> CaptionBatches:
    return CaptionBatches(
        train,
        compute(train),
        text,
        batch_size=12,
        max_frames=40,
        min_frames=8,
        seed=1,
        rank=rank,
        world=world,
        rewordings=made,
    )


def said(batch: CaptionBatch) -> list[str]:
    """The words that were encoded, read from the tokens."""
    words = batch["conditions"]["text"]
    codes = (words.features[..., 0] * 128).round().int()
    return ["".join(map(chr, row[mask].tolist())) for row, mask in zip(codes, words.mask, strict=True)]


def test_ranks_read_the_same_rewordings(
    train: ShardDataset, text: TextCache, captions: set[str], tmp_path: Path
) -> None:
    made = rewordings(tmp_path, captions, Letters(), 0.6)
    replaced = []
    for k in (0, 4, 9):
        whole = batches(train, text, made)[k]
        shares = [batches(train, text, made, rank, 2)[k] for rank in range(2)]
        assert said(whole) == [words for share in shares for words in said(share)]
        assert torch.equal(whole["similarity"], torch.from_numpy(text.sentence(whole["caption"])))
        replaced += [a != b for a, b in zip(said(whole), whole["caption"], strict=True)]
    assert any(replaced) and not all(replaced)


def test_without_them_and_never_taken_are_the_same(
    train: ShardDataset, text: TextCache, captions: set[str], tmp_path: Path
) -> None:
    plain, never = (
        batches(train, text, made)[3]
        for made in (None, rewordings(tmp_path, captions, Letters(), 0.0))
    )  # fmt: skip
    assert plain["caption"] == never["caption"]
    for name in ("motion", "length", "index", "similarity"):
        assert torch.equal(plain[name], never[name]), name
    for one, other in zip(plain["conditions"]["text"], never["conditions"]["text"], strict=True):
        assert one is not None and other is not None and torch.equal(one, other)


def test_another_encoder_is_refused(
    train: ShardDataset, text: TextCache, captions: set[str], tmp_path: Path
) -> None:
    made = rewordings(tmp_path, captions, Letters("others"), 0.5)
    with pytest.raises(UserError, match="rewordings by the encoder others, captions by letters"):
        batches(train, text, made)
