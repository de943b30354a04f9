"""`Tokenizer`: what every motion tokenizer offers to its trainer and to the stages behind it.

A tokenizer consumes exactly the layout columns it models, already normalised; `select` picks them out of full
frames. Four frames are one group: `length` is rounded up to whole groups, so the last group of a clip may
hold padded (zero) frames, and a padded batch gives what each clip gives alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.quantize.base import Codebook
from motionloom.models.tokenizer.config import BaseTokenizerConfig

GROUP_FRAMES = 4


class Stream(NamedTuple):
    """One kind of token."""

    name: str
    num_codes: int
    per_group: int
    """Tokens per group of `group_frames` frames."""


class TokenizerOutput(NamedTuple):
    """What `Tokenizer.forward` returns."""

    recon: Tensor
    """[B, T, dim]; zero after the last valid group."""
    penalty: Tensor
    """Commitment, summed over codebooks; scalar."""
    codes: dict[str, Tensor]
    """Per stream int64 [B, T / 4 * per_group]; meaningless after the last valid group."""
    metrics: dict[str, Tensor]
    """`perplexity_<stream>`, `usage_`, `dead_`, `resets_`, `penalty_`; scalars."""


class Latents(NamedTuple):
    """Quantized latents on the way from the encoders to the decoder."""

    joined: Tensor
    """[B, L, d'], the decoder's input."""
    penalty: Tensor
    codes: dict[str, Tensor]
    metrics: dict[str, Tensor]


class Tokenizer(nn.Module, ABC):
    """Motion [B, T, dim] to tokens and back; T is a multiple of 4.

    Subclasses set `decoder` and implement `codebooks`, `_quantize` and `_join`.

    Args:
        config: Sizes and losses.
        layout: Layout of the full frames.
        part: Which columns of the layout are modelled.
        streams: Kinds of tokens.
        pattern: Order of the streams' tokens within one group, e.g. ("body", "body", "hand").
    """

    group_frames = GROUP_FRAMES
    columns: Tensor
    decoder: nn.Module

    def __init__(
        self,
        config: BaseTokenizerConfig,
        layout: MotionLayout,
        part: Part,
        streams: tuple[Stream, ...],
        pattern: tuple[str, ...],
    ) -> None:
        super().__init__()
        if not layout.has_part(part):
            raise UserError(
                f"layout {layout.name} has no {part} columns; choose another `part` or another data set"
            )
        self.config = config
        self.layout = layout
        self.streams = streams
        self.pattern = pattern
        self.is_frozen = False
        self.register_buffer("columns", torch.from_numpy(layout.part(part)))

    @property
    def dim(self) -> int:
        """Number of columns modelled."""
        return len(self.columns)

    def select(self, x: Tensor) -> Tensor:
        """The columns this tokenizer models, [..., D of the layout] -> [..., dim]."""
        return x[..., self.columns]

    @abstractmethod
    def codebooks(self) -> dict[str, Codebook]:
        """The quantizer of each stream."""

    @abstractmethod
    def _quantize(self, x: Tensor, valid: Tensor | None, *, update: bool) -> Latents:
        """Encode and quantize x [B, T, dim]; `valid` [B] counts frames in whole groups."""

    @abstractmethod
    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        """Code vectors per stream [B, T / 4 * per_group, d] -> the decoder's input."""

    def forward(self, x: Tensor, length: Tensor | None = None) -> TokenizerOutput:
        """Reconstruct x [B, T, dim]; `length` [B] = valid frames. Updates the codebooks in training mode."""
        valid = self._valid(x, length)
        latents = self._quantize(x, valid, update=True)
        recon = self.decoder(latents.joined, valid)
        return TokenizerOutput(recon, latents.penalty, latents.codes, latents.metrics)

    @torch.no_grad()
    def encode(self, x: Tensor, length: Tensor | None = None) -> dict[str, Tensor]:
        """Tokens of x [B, T, dim], per stream int64 [B, T / 4 * per_group]. Never updates a codebook.

        Of a clip of `length` frames the first ceil(length / 4) * per_group tokens mean something.
        """
        return self._quantize(x, self._valid(x, length), update=False).codes

    def decode(self, codes: dict[str, Tensor], length: Tensor | None = None) -> Tensor:
        """Motion [B, T, dim] of tokens; `length` [B] in frames where clips of a batch differ."""
        books = self.codebooks()
        return self._decode({s.name: books[s.name].vectors(codes[s.name]) for s in self.streams}, length)

    def decode_soft(self, weights: dict[str, Tensor], length: Tensor | None = None) -> Tensor:
        """`decode` for weights over the codes [B, L, K], differentiable in them; one-hot gives `decode`."""
        books = self.codebooks()
        vectors = {s.name: weights[s.name] @ books[s.name].codebook.to(weights[s.name]) for s in self.streams}
        return self._decode(vectors, length)

    def freeze(self) -> Self:
        """Evaluation for good: no gradients, no codebook updates, whatever `.train()` a parent calls."""
        self.eval()
        self.requires_grad_(False)
        for book in self.codebooks().values():
            book.freeze()
        self.is_frozen = True
        return self

    def train(self, mode: bool = True) -> Self:
        """Training mode, unless frozen."""
        return super().train(mode and not self.is_frozen)

    def _decode(self, vectors: dict[str, Tensor], length: Tensor | None) -> Tensor:
        motion: Tensor = self.decoder(self._join(vectors), _whole_groups(length))
        return motion

    def _valid(self, x: Tensor, length: Tensor | None) -> Tensor | None:
        if x.shape[-1] != self.dim:
            raise UserError(
                f"this tokenizer models {self.dim} columns of layout {self.layout.name}, "
                f"the motion has {x.shape[-1]}; pick them with `select`"
            )
        if x.shape[1] % GROUP_FRAMES:
            raise UserError(f"{x.shape[1]} frames: a tokenizer needs a multiple of {GROUP_FRAMES}")
        return _whole_groups(length)


def _whole_groups(length: Tensor | None) -> Tensor | None:
    """Frames rounded up to whole groups."""
    if length is None:
        return None
    return (length + GROUP_FRAMES - 1) // GROUP_FRAMES * GROUP_FRAMES


def token_mask(valid: Tensor | None, tokens: int, stride: int) -> Tensor | None:
    """True where a token is real, [B, tokens]; `valid` [B] in frames, one token per `stride` frames."""
    if valid is None:
        return None
    return torch.arange(tokens, device=valid.device) * stride < valid[:, None]


def stream_metrics(metrics: dict[str, Tensor], stream: str) -> dict[str, Tensor]:
    """A quantizer's metrics under the names of one stream."""
    return {f"{name}_{stream}": value for name, value in metrics.items()}
