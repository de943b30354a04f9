"""Trained networks loaded for use: frozen, in eval mode, with the facts a caller needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.datasets.text.cache import TextCache
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import parse_tokenizer
from motionloom.pipeline.store.weights import load_facts, load_weights

CPU = torch.device("cpu")


def freeze(net: torch.nn.Module) -> None:
    """Evaluation mode and no gradients."""
    net.eval()
    net.requires_grad_(False)


def device_of(net: torch.nn.Module) -> torch.device:
    """Where a network lies, and what it is given must lie."""
    return next(net.parameters()).device


def load_tokenizer(folder: Path, device: torch.device = CPU) -> Tokenizer:
    """A trained tokenizer."""
    facts = load_facts(folder)
    config = parse_tokenizer(facts.config, f"{folder / 'model.json'}: config")
    net = build_tokenizer(config, facts.layout.layout())
    load_weights(folder, net)
    return net.freeze().to(device)


@dataclass(frozen=True)
class LoadedTma:
    """A trained alignment model and the columns it reads.

    Its methods take tensors of any device and give those of its own.
    """

    net: Tma
    layout: MotionLayout
    max_frames: int
    part: Part
    """The columns it reads."""

    @staticmethod
    def load(folder: Path, device: torch.device = CPU) -> LoadedTma:
        """Read from a tma stage."""
        facts = load_facts(folder)
        layout, part = facts.layout.layout(), facts.extra.get("part", "bodyhand")
        if part not in get_args(Part) or not layout.has_part(part):
            raise UserError(
                f"{folder / 'model.json'}: key 'extra.part' = {part!r} is no part of layout {layout.name}; "
                "run or export the stage again"
            )
        text_dim = facts.fact(folder, "text_dim", int)
        net = Tma.of_layout(TmaConfig.parse(facts.config, str(folder)), layout, part, text_dim)
        load_weights(folder, net)
        freeze(net.to(device))
        frames = facts.fact(folder, "max_frames", int)
        return LoadedTma(net, layout, frames, part)

    @property
    def device(self) -> torch.device:
        """Where the network lies."""
        return device_of(self.net)

    @torch.no_grad()
    def embed_text(self, tokens: Tensor, mask: Tensor, batch: int = 256) -> Tensor:
        """Text latents [n, 256] (the means)."""
        spans = [slice(first, first + batch) for first in range(0, len(tokens), batch)]
        near = [(tokens[span].to(self.device), mask[span].to(self.device)) for span in spans]
        return torch.cat([self.net.encode_text(*given)[0] for given in near])

    def embed_captions(self, texts: list[str], cache: TextCache) -> Tensor:
        """Text latents of captions in the cache, on the CPU."""
        out = []
        for start in range(0, len(texts), 256):
            tokens, mask = cache.tokens(texts[start : start + 256])
            out.append(self.embed_text(torch.as_tensor(tokens), torch.as_tensor(mask)).cpu())
        return torch.cat(out)

    @torch.no_grad()
    def embed_motion(self, motion: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        """Motion latents [B, 256] of normalised features [B, T, D], the columns of `part`.

        `present` bool [B, D]: those that each motion holds (None = all).
        """
        near = None if present is None else present.to(self.device)
        return self.net.encode_motion(motion.to(self.device), length.to(self.device), near)[0]


def load_gpt(folder: Path, tokenizer: Tokenizer) -> tuple[InterleavedGPT, str]:
    """A trained GPT, on the tokenizer's device, and its kind of text prior ("tma" or "sentence")."""
    facts = load_facts(folder)
    expected = {s.name: s.num_codes for s in tokenizer.streams}
    streams, pattern = facts.fact(folder, "streams", dict), facts.fact(folder, "pattern", list)
    if streams != expected or tuple(pattern) != tuple(tokenizer.pattern):
        raise UserError(
            f"{folder}: this GPT was trained on streams {streams}, "
            f"the tokenizer has {expected}; train it again on this tokenizer"
        )
    config = GptConfig.parse(facts.config, str(folder))
    net = InterleavedGPT(config, tokenizer.streams, tokenizer.pattern, facts.fact(folder, "text_dim", int))
    load_weights(folder, net)
    freeze(net.to(device_of(tokenizer)))
    return net, facts.fact(folder, "prior", str)
