"""Text encoders in a few lines and tiny ones of transformers, for tests that need captions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from motionloom.datasets.loading.condition_batches import ConditionBatches
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText


class OneToken:
    """A text encoder that says the same of everything."""

    name, dim = "one-token", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        ones = np.ones((len(captions), 1, 4), dtype=np.float32)
        return EncodedText(ones[:, 0] / 2, ones, np.ones((len(captions), 1), dtype=bool))


class WordLengths:
    """One token a word, all its values the word's length."""

    name, dim = "word-lengths", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        words = [caption.split() for caption in captions]
        tokens = np.zeros((len(words), max(map(len, words)), 4), dtype=np.float32)
        for row, own in zip(tokens, words, strict=True):
            row[: len(own)] = np.array([len(word) for word in own])[:, None]
        return EncodedText(np.full((len(words), 4), 0.5, dtype=np.float32), tokens, tokens[..., 0] > 0)


def caption_batches(
    dataset: Any, stats: Any, text: TextCache, *, about: Any = "body", **options: Any
) -> ConditionBatches:
    """Batches of captioned clips."""
    return ConditionBatches(dataset, stats, {"text": text}, captioned=about, **options)


def tiny_vocabulary(folder: Path) -> Path:
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "a", "person", "walks", "jump", "someone", "left"]
    (folder / "vocab.txt").write_text("\n".join(words))
    return folder / "vocab.txt"


def tiny_distilbert(folder: Path, seed: int = 0) -> Path:
    from transformers import BertTokenizerFast, DistilBertConfig, DistilBertModel

    torch.manual_seed(seed)
    config = DistilBertConfig(vocab_size=11, dim=16, n_layers=2, n_heads=2, hidden_dim=32)
    DistilBertModel(config).save_pretrained(folder / "model")
    BertTokenizerFast(vocab=str(tiny_vocabulary(folder))).save_pretrained(folder / "model")
    return folder / "model"


def tiny_clip(folder: Path) -> Path:
    from transformers import CLIPTextConfig, CLIPTextModelWithProjection, CLIPTokenizerFast

    letters = [*"abcdefghijklmnopqrstuvwxyz", *(f"{c}</w>" for c in "abcdefghijklmnopqrstuvwxyz")]
    vocabulary = {word: i for i, word in enumerate([*letters, "<|startoftext|>", "<|endoftext|>"])}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    end = vocabulary["<|endoftext|>"]
    torch.manual_seed(0)
    config = CLIPTextConfig(
        vocab_size=len(vocabulary), hidden_size=16, intermediate_size=32, num_hidden_layers=2,
        num_attention_heads=2, projection_dim=16, max_position_embeddings=12, bos_token_id=end - 1,
        eos_token_id=end, pad_token_id=end,
    )  # fmt: skip
    CLIPTextModelWithProjection(config).eval().save_pretrained(folder / "clip")
    CLIPTokenizerFast(vocab=str(folder / "vocab.json"), merges=str(folder / "merges.txt")).save_pretrained(
        folder / "clip"
    )
    return folder / "clip"
