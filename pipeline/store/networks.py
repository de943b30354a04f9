"""Trained networks as later stages use them: frozen, with the statistics of what they read and write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import PRESENT_ALL
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tma.network import Tma
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.pipeline.store.weights import ModelFacts

CPU = torch.device("cpu")


def device_of(net: torch.nn.Module) -> torch.device:
    """Return the device of a network's parameters; its inputs must be there too."""
    return next(net.parameters()).device


@dataclass(frozen=True)
class TrainedTokenizer:
    """A trained tokenizer and the statistics of its motion."""

    net: Tokenizer
    given: Mapping[str, Any]
    """The stage's loaded inputs; "stats" is read."""

    @property
    def layout(self) -> MotionLayout:
        return self.net.layout

    @cached_property
    def columns(self) -> NDArray[np.int64]:
        """Columns of the layout that it models, [C]."""
        return self.net.columns.cpu().numpy()

    @property
    def stats(self) -> FeatureStats:
        stats: FeatureStats = self.given["stats"]
        return stats

    @torch.no_grad()
    def encode(self, motions: Sequence[NDArray[np.float32]], present: Sequence[int] | None = None) -> Codes:
        """Tokens of motions [T, C], its columns in their own units; what exceeds whole groups is left out.

        `present` [n] says by the bits of `ClipMeta.present` what each motion holds; None = all.
        """
        groups = torch.tensor([len(motion) // GROUP_FRAMES for motion in motions])
        batch = torch.zeros(len(motions), int(groups.max()) * GROUP_FRAMES, self.net.dim)
        mean = self.stats.mean[self.columns]
        std = self.stats.std[self.columns]
        for row, motion, count in zip(batch, motions, (groups * GROUP_FRAMES).tolist(), strict=True):
            row[:count] = torch.from_numpy(((motion[:count] - mean) / std).astype(np.float32))
        device = device_of(self.net)
        groups = groups.to(device)
        held = None
        if present is not None:
            held = torch.from_numpy(self.layout.present_columns[list(present)][:, self.columns]).to(device)
        return Codes(self.net.encode(batch.to(device), groups * GROUP_FRAMES, held), groups)

    @torch.no_grad()
    def decode(self, codes: Mapping[str, Tensor], groups: Sequence[int]) -> list[NDArray[np.float32]]:
        """Features in their own units, [T, C] a sample; none is padded for another.

        `codes`: per stream int64 [B, G * per_group]; `groups` [B]: valid groups of each.
        """
        alone = device_of(self.net).type == "cpu"
        at_once: dict[tuple[int, int], list[int]] = {}
        for row, count in enumerate(groups):
            # A GPU takes hardly longer for all of one length than for one; a CPU rounds them as one alone.
            at_once.setdefault((count, row if alone else 0), []).append(row)
        out: dict[int, NDArray[np.float32]] = {}
        for (count, _), rows in at_once.items():
            some = {s.name: codes[s.name][rows, : count * s.per_group] for s in self.net.streams}
            out |= zip(rows, map(self.own_units, self.net.decode(some).cpu()), strict=True)
        return [out[row] for row in range(len(groups))]

    def of_coordinates(self, seen: Tensor) -> NDArray[np.float32]:
        """Motion [T, C] in the coordinates that the tokenizer reads -> its own units."""
        return self.own_units(self.net.features(seen[None])[0])

    def own_units(self, motion: Tensor) -> NDArray[np.float32]:
        """Normalised features [T, C] of its columns -> metres, radians and expression values."""
        values = motion.cpu().numpy()
        return np.asarray(self.stats.denormalize(values, self.columns), dtype=np.float32)

    @torch.no_grad()
    def reconstruct(self, features: NDArray[np.float32], present: int = PRESENT_ALL) -> NDArray[np.float32]:
        """Through the tokenizer and back, [T, C] of its columns in their own units; T a multiple of four.

        `present` says what the clip holds; of what it does not hold, nothing is read and the mean comes back.
        """
        columns = self.columns
        device = device_of(self.net)
        mean = self.stats.mean[columns]
        std = self.stats.std[columns]
        motion = torch.from_numpy(((features - mean) / std).astype(np.float32))[None].to(device)
        mask = torch.from_numpy(self.layout.present_columns[present, columns])[None].to(device)
        rebuilt = self.net.decode(self.net.encode(motion, present=mask), present=mask)
        out = rebuilt.masked_fill(~mask[:, None], 0.0)[0].cpu().numpy()
        return np.asarray(out * std + mean, dtype=np.float32)


class TokensOfCaptions(Protocol):
    """A cache of encoded captions, or a text stage."""

    def tokens(self, captions: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]: ...


@dataclass(frozen=True)
class LoadedTma:
    """A trained alignment model with its columns and statistics; tensors may be on any device."""

    net: Tma
    layout: MotionLayout
    max_frames: int
    part: Part
    """The columns it reads."""
    given: Mapping[str, Any]
    """The stage's loaded inputs; "stats" and "text" are read."""

    @property
    def stats(self) -> FeatureStats:
        stats: FeatureStats = self.given["stats"]
        return stats

    @property
    def device(self) -> torch.device:
        return device_of(self.net)

    @torch.no_grad()
    def embed_text(self, tokens: Tensor, mask: Tensor, batch: int = 256) -> Tensor:
        """Text latents [n, 256] (the means)."""
        spans = [slice(first, first + batch) for first in range(0, len(tokens), batch)]
        near = [(tokens[span].to(self.device), mask[span].to(self.device)) for span in spans]
        return torch.cat([self.net.encode_text(*given)[0] for given in near])

    def embed_captions(self, texts: list[str], cache: TokensOfCaptions) -> Tensor:
        """Text latents of captions, on the CPU, by a cache that has them all or by a text stage."""
        out = []
        for start in range(0, len(texts), 256):
            tokens, mask = cache.tokens(texts[start : start + 256])
            out.append(self.embed_text(torch.as_tensor(tokens), torch.as_tensor(mask)).cpu())
        return torch.cat(out)

    @torch.no_grad()
    def embed_motion(self, motion: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        """Motion latents [B, 256] of normalised features [B, T, D]; `present` bool [B, D], None = all."""
        near = None if present is None else present.to(self.device)
        return self.net.encode_motion(motion.to(self.device), length.to(self.device), near)[0]


@dataclass(frozen=True)
class LoadedGpt:
    """A trained GPT and its kind of text prior ("tma" or "sentence")."""

    net: InterleavedGPT
    prior: str


N = TypeVar("N", bound=torch.nn.Module)


@dataclass(frozen=True)
class LoadedWindowed(Generic[N]):
    """A trained network over windows of motion, such as UDE's token model and its decoder."""

    net: N
    window: int
    """Frames of a training window."""
    given: Mapping[str, Any]
    """The stage's loaded inputs: "tokenizer", and of a token model "text" and "audio" by its modalities."""


def stream_facts(tokenizer: Tokenizer) -> dict[str, object]:
    """Return the facts of a network over a tokenizer's codes: `streams` (codes by name) and `pattern`."""
    return {
        "streams": {stream.name: stream.num_codes for stream in tokenizer.streams},
        "pattern": list(tokenizer.pattern),
    }


def require_streams(facts: ModelFacts, tokenizer: Tokenizer, what: str) -> None:
    """`UserError` unless the tokenizer has the streams and the pattern that the network was trained on."""
    here = stream_facts(tokenizer)
    streams = facts.fact("streams", dict)
    pattern = facts.fact("pattern", list)
    if (streams, pattern) != (here["streams"], here["pattern"]):
        raise UserError(
            f"{facts.where}: this {what} was trained on streams {streams} in the order {pattern}, the "
            f"tokenizer has {here['streams']} in the order {here['pattern']}; train it again on this one"
        )
