"""MiniLM (all-MiniLM-L6-v2), read from its folder with nothing but torch and the tokenizer's own library.

The encoder that comes with the installation is the first thing that every command with words waits for. The
libraries that it is usually loaded by import thousands of modules, several seconds on one core, for a network
of six layers; so it stands here in full: BERT (Devlin et al. 2019, §3) and the mean over the caption's
tokens. Numbers are those of sentence-transformers, within the noise of float32.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional as F

from motionloom.datasets.schema import UserError

_PREFIX = "0.model."
"""Prefix of the weights' names in sentence-transformers, which the digest is made of."""


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Twelve hex digits of the weights' sha256: other weights of the same name do not share a cache."""
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:12]


class MiniLm:
    """The network and its tokenizer, from the folder of the model."""

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        try:
            facts = json.loads((folder / "config.json").read_text(encoding="utf-8"))
            longest = json.loads((folder / "sentence_bert_config.json").read_text(encoding="utf-8"))
            self._heads, self._layers = int(facts["num_attention_heads"]), int(facts["num_hidden_layers"])
            self.dim, self._eps = int(facts["hidden_size"]), float(facts["layer_norm_eps"])
            weights = load_file(folder / "model.safetensors")
            self.tokenizer = _tokenizer(folder, int(longest["max_seq_length"]))
        except Exception as error:  # a missing file, no JSON, no weights: each library raises its own kind
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise UserError(f"{folder}: not a readable text model: {reason}") from error
        self._weights = {name: x.to(device) for name, x in weights.items() if x.is_floating_point()}
        self.device = device

    @cached_property
    def digest(self) -> str:
        return weights_digest({_PREFIX + name: value for name, value in self._weights.items()})

    @torch.inference_mode()
    def __call__(self, captions: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
        """Sentence embeddings [B, E] of unit length; last hidden states [B, S, E]; mask [B, S]."""
        read = self.tokenizer.encode_batch(list(captions))
        numbers = torch.tensor([row.ids for row in read]).to(self.device)
        mask = torch.tensor([row.attention_mask for row in read]).to(self.device)
        states = self._states(numbers, mask.bool())
        weight = mask[..., None].float()
        mean = (states * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-9)
        return F.normalize(mean, dim=-1), states, mask

    def _states(self, numbers: Tensor, mask: Tensor) -> Tensor:
        """Last hidden states [B, S, E] of token numbers [B, S]."""
        words, kinds, places = (
            self._weights[f"embeddings.{name}_embeddings.weight"]
            for name in ("word", "token_type", "position")
        )
        x = words[numbers] + kinds[0] + places[: numbers.shape[1]]
        x = self._norm("embeddings", x)
        seen = None if bool(mask.all()) else mask[:, None, None, :].expand(-1, -1, mask.shape[1], -1)
        for layer in range(self._layers):
            at = f"encoder.layer.{layer}"
            q, k, v = (self._heads_of(f"{at}.attention.self.{name}", x) for name in ("query", "key", "value"))
            heads = F.scaled_dot_product_attention(q, k, v, attn_mask=seen)
            attended = heads.transpose(1, 2).reshape(x.shape)
            attended = self._linear(f"{at}.attention.output.dense", attended)
            x = self._norm(f"{at}.attention.output", attended + x)
            hidden = F.gelu(self._linear(f"{at}.intermediate.dense", x))
            x = self._norm(f"{at}.output", self._linear(f"{at}.output.dense", hidden) + x)
        return x

    def _heads_of(self, name: str, x: Tensor) -> Tensor:
        """One projection [B, S, E], split into heads [B, H, S, E / H]."""
        return self._linear(name, x).view(*x.shape[:2], self._heads, -1).transpose(1, 2)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return F.linear(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _norm(self, name: str, x: Tensor) -> Tensor:
        weight, bias = (self._weights[f"{name}.LayerNorm.{part}"] for part in ("weight", "bias"))
        return F.layer_norm(x, (self.dim,), weight, bias, self._eps)


def _tokenizer(folder: Path, longest: int) -> Any:
    """The tokenizer's file, cutting at the model's length and padding to the longest of a batch."""
    from tokenizers import Tokenizer

    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.enable_truncation(longest)
    tokenizer.enable_padding(pad_id=tokenizer.token_to_id("[PAD]"), pad_token="[PAD]")
    return tokenizer
