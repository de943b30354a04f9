"""`Tokenizer`: what every motion tokenizer offers to its trainer and to later stages.

A tokenizer consumes exactly the layout columns it models, already normalised; `select` picks them out of full
frames. Four frames are one group: `length` is rounded up to whole groups, so the last group of a clip may
hold padded (zero) frames, and a padded batch gives what each clip gives alone.

Columns that a clip does not hold (`present` bool [B, dim]; hands, face) are read as 0, the mean. A stream of
tokens that belongs to such a part alone does not learn from the clip, and its vectors are 0 in the decoder.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cached_property
from typing import Literal, NamedTuple, Self, TypedDict

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.layers.basis import Basis
from motionloom.models.quantize.base import Codebook, QuantizerConfig

GROUP_FRAMES = 4
"""Frames of a group, whose tokens belong together (HumanTOMATO 3.2)."""

Recon = Literal["l1", "l2", "smooth_l1"]


class ConvSizes(TypedDict):
    """Keyword arguments of the convolutional encoders and decoders."""

    width: int
    depth: int
    dilation_growth: int


class TokenizerConfig(Config):
    """Settings of every tokenizer; the defaults are the papers' (HumanTOMATO B.2, UDE section 4.2)."""

    kind: str

    width: int = Field(default=512, ge=1)
    """Channels of the convolutions."""
    depth: int = Field(default=3, ge=1, le=32)
    """Residual blocks per resolution."""
    dilation_growth: int = Field(default=3, ge=1, le=16)
    code_dim: int = Field(default=512, ge=1)
    recon: Recon = "l2"
    velocity_weight: float = Field(default=0.0, ge=0)
    """Weight of the same reconstruction error between frame-to-frame differences."""
    position_weight: float = Field(default=0.0, ge=0)
    """Weight of the same reconstruction error of the joints' positions alone, as in T2M-GPT's public code."""
    root_gain: float = Field(default=1.0, gt=0)
    """Weight of the root's columns relative to others [ours]; see `layers/basis.py`."""
    finger_gain: float = Field(default=0.0, ge=0)
    """Above 0, fingers count by how they bend, in bone lengths times this [ours]; see `layers/basis.py`."""

    def conv_sizes(self) -> ConvSizes:
        """Keyword arguments of encoders and decoders."""
        return {"width": self.width, "depth": self.depth, "dilation_growth": self.dilation_growth}

    def commitment(self) -> float:
        """Weight of the quantizers' penalty; 0 for quantizers without one."""
        return 0.0

    def codes_and_reset(self) -> tuple[int, float] | None:
        """Return the size of each codebook and the uses below which a code is reset; None without resets."""
        return None

    @abstractmethod
    def build(self, layout: MotionLayout) -> Tokenizer:
        """Return an untrained tokenizer for motion of `layout`; `UserError` if the layout lacks the part."""


class EmaTokenizerConfig(TokenizerConfig):
    """Settings of tokenizers whose codebooks are moving averages."""

    num_codes: int = Field(default=512, ge=2)
    decay: float = Field(default=0.99, gt=0, lt=1)
    reset_below: float = Field(default=1.0, gt=0)
    alpha: float = Field(default=0.02, ge=0)
    """Weight of the commitment penalty."""

    def commitment(self) -> float:
        return self.alpha

    def quantizer(self) -> QuantizerConfig:
        return QuantizerConfig(
            num_codes=self.num_codes, dim=self.code_dim, decay=self.decay, reset_below=self.reset_below
        )

    def codes_and_reset(self) -> tuple[int, float]:
        return self.num_codes, self.reset_below


class Stream(NamedTuple):
    """One kind of token."""

    name: str
    num_codes: int
    per_group: int
    """Tokens per group of `group_frames` frames."""


class TokenizerOutput(NamedTuple):
    """The result of `Tokenizer.forward`."""

    input: Tensor
    """[B, T, dim], the encoders' input in the coordinates of `Basis`; 0 in missing columns."""
    reconstruction: Tensor
    """[B, T, dim], the decoder's output in the same coordinates; `features` turns it into motion."""
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
        pattern: Order of the streams' tokens within one group, e.g. ("body", "body", "hand").
    """

    group_frames = GROUP_FRAMES
    columns: Tensor
    decoder: nn.Module

    def __init__(
        self,
        config: TokenizerConfig,
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
        self.part: Part = part
        self.streams = streams
        self.pattern = pattern
        self.is_frozen = False
        columns = layout.part(part)
        self.register_buffer("columns", torch.from_numpy(columns))
        self.basis = Basis(layout, columns, root_gain=config.root_gain, finger_gain=config.finger_gain)

    @property
    def dim(self) -> int:
        return len(self.columns)

    @property
    def bits_per_second(self) -> float:
        """Bits that the codes of one second of motion carry, so that tokenizers compare fairly."""
        groups = self.layout.fps / GROUP_FRAMES
        return groups * sum(s.per_group * math.log2(s.num_codes) for s in self.streams)

    @cached_property
    def position_columns(self) -> list[int]:
        """Those of its columns that are positions of joints."""
        positions = range(self.layout.dim)[self.layout.slice("positions")]
        return [at for at, column in enumerate(self.columns.tolist()) if column in positions]

    def select(self, x: Tensor) -> Tensor:
        """The columns this tokenizer models, [..., D of the layout] -> [..., dim]."""
        return x[..., self.columns]

    @abstractmethod
    def codebooks(self) -> dict[str, Codebook]: ...

    @abstractmethod
    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        """Encode and quantize x [B, T, dim]; `valid` [B] counts frames in whole groups.

        `missing`, bool [B] per stream, is true of clips that do not hold the stream's part (`missing`).
        """

    @abstractmethod
    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        """Code vectors per stream [B, T / 4 * per_group, d] -> the decoder's input."""

    def missing(self, present: Tensor | None) -> dict[str, Tensor]:
        """Bool [B] for each optional stream: True where `present` [B, dim] (None: all) lacks its part."""
        return {}

    def recorded(self, present: Tensor) -> Tensor:
        """bool [B, K]: streams, in the order of the pattern, that say what was recorded of clips which hold
        the columns `present` [B, dim].
        """
        missing = self.missing(present)
        # A tokenizer that gives a part a stream of its own keeps that part out of the other streams.
        others = torch.ones_like(present[:, 0]) if missing else present.all(1)
        names = dict.fromkeys(self.pattern)
        return torch.stack([~missing[name] if name in missing else others for name in names], dim=1)

    def forward(
        self, x: Tensor, length: Tensor | None = None, present: Tensor | None = None
    ) -> TokenizerOutput:
        """Encode, quantize and decode x [B, T, dim]; `length` [B] = valid frames. Training updates codebooks.

        `present` [B, dim]: false where a clip does not hold a column; None = all are present.
        """
        valid = self._valid(x, length)
        coordinates = self.coordinates(x, present)
        latents = self._quantize(coordinates, valid, self.missing(present), update=True)
        reconstruction = self.decoder(latents.joined, valid)
        return TokenizerOutput(coordinates, reconstruction, latents.penalty, latents.codes, latents.metrics)

    def coordinates(self, x: Tensor, present: Tensor | None = None) -> Tensor:
        """Motion [B, T, dim] in the coordinates of `Basis`; zero in absent columns. Undone by `features`."""
        coordinates = self.basis.encode(x)
        return coordinates if present is None else coordinates.masked_fill(~present[:, None], 0.0)

    @torch.no_grad()
    def encode(
        self, x: Tensor, length: Tensor | None = None, present: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Tokens of x [B, T, dim], per stream int64 [B, T / 4 * per_group]. Never updates a codebook.

        Of a clip of `length` frames the first ceil(length / 4) * per_group tokens mean something; all are
        valid codes, also those of a part that the clip does not hold.
        """
        valid = self._valid(x, length)
        return self._quantize(self.coordinates(x, present), valid, self.missing(present), update=False).codes

    def decode(
        self, codes: dict[str, Tensor], length: Tensor | None = None, present: Tensor | None = None
    ) -> Tensor:
        """Motion [B, T, dim] of tokens; `length` [B] in frames where clips of a batch differ.

        With the `present` that `encode` was given, the body comes out as in training, which knows of no hands
        there; the columns that are not present mean nothing.
        """
        books = self.codebooks()
        vectors = {s.name: books[s.name].vectors(codes[s.name]) for s in self.streams}
        return self._decode(vectors, length, present)

    def decode_soft(
        self, weights: dict[str, Tensor], length: Tensor | None = None, present: Tensor | None = None
    ) -> Tensor:
        """`decode` for weights over the codes [B, L, K], differentiable in them; one-hot gives `decode`."""
        books = self.codebooks()
        vectors = {s.name: weights[s.name] @ books[s.name].codebook.to(weights[s.name]) for s in self.streams}
        return self._decode(vectors, length, present)

    def features(self, coordinates: Tensor, length: Tensor | None = None) -> Tensor:
        """Motion [B, T, dim] from the decoder's coordinates, exactly zero after the last valid group."""
        motion = self.basis.decode(coordinates)
        mask = token_mask(_whole_groups(length), motion.shape[1], 1)
        return motion if mask is None else motion.masked_fill(~mask[..., None], 0.0)

    def freeze(self) -> Self:
        """Evaluation for good: no gradients, no codebook updates, whatever `.train()` a parent calls."""
        self.eval()
        self.requires_grad_(False)
        for book in self.codebooks().values():
            book.freeze()
        self.is_frozen = True
        return self

    def train(self, mode: bool = True) -> Self:
        return super().train(mode and not self.is_frozen)

    def _decode(self, vectors: dict[str, Tensor], length: Tensor | None, present: Tensor | None) -> Tensor:
        for name, missing in self.missing(present).items():
            vectors[name] = without(vectors[name], missing)
        return self.features(self.decoder(self._join(vectors), _whole_groups(length)), length)

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


def without(vectors: Tensor, missing: Tensor | None) -> Tensor:
    """Vectors [B, L, d], zero for the clips that lack their part (`missing` bool [B])."""
    return vectors if missing is None else vectors.masked_fill(missing[:, None, None], 0.0)


def token_mask(
    valid: Tensor | None, tokens: int, stride: int, missing: Tensor | None = None
) -> Tensor | None:
    """True where a token is real, [B, tokens]; `valid` [B] in frames, one token per `stride` frames.

    No token is real of a clip that lacks the stream's part (`missing` bool [B]).
    """
    if valid is None:
        return None if missing is None else (~missing)[:, None].expand(-1, tokens)
    real = torch.arange(tokens, device=valid.device) * stride < valid[:, None]
    return real if missing is None else real & ~missing[:, None]


def stream_metrics(metrics: dict[str, Tensor], stream: str) -> dict[str, Tensor]:
    """A quantizer's metrics under the names of one stream."""
    return {f"{name}_{stream}": value for name, value in metrics.items()}
