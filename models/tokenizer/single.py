"""Tokenizers with one encoder, one decoder and one token per codebook and four frames.

- `SingleTokenizer`: vanilla VQ and RVQ (HumanTOMATO appendix G) and the face RVQ (B.4).
- `FsqTokenizer`: the same convolutions around finite scalar quantization.
- `MotionQuantizer`: the MQ of UDE (section 3.1), strided convolutions around one codebook of 2048 codes. It
  models the layout of its data: UDE's 75-dimensional SMPL vector as published, or joint features. `part:
  bodyhand`, the default, is every column but a face's.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, field_validator
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.layers.conv import ConvDecoder, ConvEncoder
from motionloom.models.layers.strided import StridedDecoder, StridedEncoder
from motionloom.models.quantize.base import Codebook
from motionloom.models.quantize.ema import EmaQuantizer, ResidualQuantizer
from motionloom.models.quantize.fsq import FsqQuantizer
from motionloom.models.quantize.gradient import GradientQuantizer, GradientQuantizerConfig, Start
from motionloom.models.tokenizer.base import (
    EmaTokenizerConfig,
    Latents,
    Stream,
    Tokenizer,
    TokenizerConfig,
    stream_metrics,
    token_mask,
)


class VqConfig(EmaTokenizerConfig):
    """Vanilla VQ: one codebook at 4x."""

    kind: Literal["vq"] = "vq"
    part: Part = "bodyhand"

    def build(self, layout: MotionLayout) -> Tokenizer:
        return SingleTokenizer(self, layout)


class RvqConfig(EmaTokenizerConfig):
    """Residual VQ: `levels` codebooks at 4x. With `part: face` it is HumanTOMATO's face tokenizer (B.4)."""

    kind: Literal["rvq"] = "rvq"
    part: Part = "bodyhand"
    levels: int = Field(default=2, ge=1)

    def build(self, layout: MotionLayout) -> Tokenizer:
        return SingleTokenizer(self, layout)


class FsqConfig(TokenizerConfig):
    """Finite scalar quantization at 4x: no codebook to learn, so none to collapse. Not in the paper."""

    kind: Literal["fsq"] = "fsq"
    part: Part = "bodyhand"
    steps: tuple[int, ...] = Field(default=(8, 5, 5, 5), min_length=1)
    """Values of each scalar; their product, here 1000, is the number of codes."""

    @field_validator("steps")
    @classmethod
    def _several_values(cls, steps: tuple[int, ...]) -> tuple[int, ...]:
        if min(steps) < 3 or math.prod(steps) > 2**20:
            raise ValueError("every scalar needs 3 values or more, and all together at most 2^20 codes")
        return steps

    def build(self, layout: MotionLayout) -> Tokenizer:
        return FsqTokenizer(self, layout)


class MqConfig(TokenizerConfig):
    """UDE's motion quantization (section 3.1): one codebook at 4x between three-layer convolutions."""

    kind: Literal["mq"] = "mq"
    part: Part = "bodyhand"
    width: int = Field(default=1024, ge=1)
    depth: int = Field(default=1, ge=0, le=32)
    """Residual blocks after each layer that changes the rate: 1 in public UDE code, 0 is the bare text."""
    dilation_growth: int = Field(default=1, ge=1, le=16)
    code_dim: int = Field(default=1024, ge=1)
    num_codes: int = Field(default=2048, ge=2)
    quantizer: Literal["gradient", "ema"] = "gradient"
    """Learning of the codebook: by gradient (the paper), or by moving averages with Code Reset [ours]."""
    codebook_weight: float = Field(default=1.0, gt=0)
    """beta_1 of equation 2; moving averages need none."""
    commitment_weight: float = Field(default=1.0, ge=0)
    """beta_2 of equation 2."""
    start: Start = "uniform"
    """Where codes learnt by gradient start: `uniform` in +-1/K (public UDE), or `data`, on latents of the
    first batch [ours], which short trainings need."""
    decay: float = Field(default=0.99, gt=0, lt=1)
    reset_below: float = Field(default=1.0, gt=0)
    """EMA count of uses below which a code is reset (`ema`), or counted as dead (`gradient`)."""

    def commitment(self) -> float:
        """Weight of the penalty; the gradient quantizer's is weighted already."""
        return 1.0 if self.quantizer == "gradient" else self.commitment_weight

    def codebook(self) -> GradientQuantizerConfig:
        return GradientQuantizerConfig(
            num_codes=self.num_codes,
            dim=self.code_dim,
            decay=self.decay,
            reset_below=self.reset_below,
            codebook_weight=self.codebook_weight,
            commitment_weight=self.commitment_weight,
            start=self.start,
        )

    def codes_and_reset(self) -> tuple[int, float] | None:
        # Codes learnt by gradient are never reset.
        return (self.num_codes, self.reset_below) if self.quantizer == "ema" else None

    def build(self, layout: MotionLayout) -> Tokenizer:
        return MotionQuantizer(self, layout)


class SingleTokenizer(Tokenizer):
    """Streams: "code" for VQ; "level0", "level1", ... for RVQ."""

    def __init__(self, config: VqConfig | RvqConfig, layout: MotionLayout) -> None:
        if isinstance(config, RvqConfig):
            names = tuple(f"level{i}" for i in range(config.levels))
        else:
            names = ("code",)
        streams = tuple(Stream(name, config.num_codes, 1) for name in names)
        super().__init__(config, layout, config.part, streams, names)
        sizes = config.conv_sizes()
        dim = config.code_dim
        self.encoder = ConvEncoder(self.dim, dim, halvings=2, **sizes)
        self.quantizer = ResidualQuantizer(config.quantizer(), len(names))
        self.decoder = ConvDecoder(dim, self.dim, doublings=2, **sizes)

    def codebooks(self) -> dict[str, Codebook]:
        return {stream.name: self.quantizer.level(i) for i, stream in enumerate(self.streams)}

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        z = self.encoder(x, valid)
        out = self.quantizer(z, token_mask(valid, z.shape[1], 4), update=update)
        metrics: dict[str, Tensor] = {}
        for i, stream in enumerate(self.streams):
            metrics |= stream_metrics({name: value[i] for name, value in out.metrics.items()}, stream.name)
        codes = {stream.name: out.codes[..., i] for i, stream in enumerate(self.streams)}
        return Latents(out.quantized, out.penalty, codes, metrics)

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        total = vectors[self.streams[0].name]
        for stream in self.streams[1:]:
            total = total + vectors[stream.name]
        return total


class OneCodebook(Tokenizer):
    """One stream, "code"; subclasses set `encoder`, `quantizer` and `decoder`."""

    encoder: nn.Module
    quantizer: FsqQuantizer | GradientQuantizer | EmaQuantizer

    def codebooks(self) -> dict[str, Codebook]:
        return {"code": self.quantizer}

    def _latents(self, x: Tensor, valid: Tensor | None) -> Tensor:
        z: Tensor = self.encoder(x, valid)
        return z

    def _quantize(
        self, x: Tensor, valid: Tensor | None, missing: dict[str, Tensor], *, update: bool
    ) -> Latents:
        z = self._latents(x, valid)
        out = self.quantizer(z, token_mask(valid, z.shape[1], 4), update=update)
        return Latents(out.quantized, out.penalty, {"code": out.codes}, stream_metrics(out.metrics, "code"))

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        return vectors["code"]


class FsqTokenizer(OneCodebook):
    """The single tokenizer's convolutions around finite scalar quantization."""

    def __init__(self, config: FsqConfig, layout: MotionLayout) -> None:
        quantizer = FsqQuantizer(config.code_dim, config.steps)
        super().__init__(config, layout, config.part, (Stream("code", quantizer.num_codes, 1),), ("code",))
        sizes = config.conv_sizes()
        dim = config.code_dim
        self.encoder = ConvEncoder(self.dim, dim, halvings=2, **sizes)
        self.quantizer = quantizer
        self.decoder = ConvDecoder(dim, self.dim, doublings=2, **sizes)

    def _latents(self, x: Tensor, valid: Tensor | None) -> Tensor:
        # Unit variance: an untrained encoder's small latents would all round to the code in the middle.
        return functional.layer_norm(super()._latents(x, valid), (self.config.code_dim,))


class MotionQuantizer(OneCodebook):
    """UDE's motion quantization."""

    def __init__(self, config: MqConfig, layout: MotionLayout) -> None:
        super().__init__(config, layout, config.part, (Stream("code", config.num_codes, 1),), ("code",))
        sizes = config.conv_sizes()
        dim = config.code_dim
        self.encoder = StridedEncoder(self.dim, dim, **sizes)
        kind = GradientQuantizer if config.quantizer == "gradient" else EmaQuantizer
        self.quantizer = kind(config.codebook())
        self.decoder = StridedDecoder(dim, self.dim, **sizes)
