"""Configs of the tokenizers; the defaults are the papers' sizes (HumanTOMATO B.2, UDE section 4.2)."""

from __future__ import annotations

import math
from typing import Any, Literal, TypedDict

from pydantic import Field, field_validator

from motionloom.datasets.motion.layout import Part
from motionloom.datasets.schema import Config, UserError
from motionloom.models.quantize.base import QuantizerConfig
from motionloom.models.quantize.gradient import GradientQuantizerConfig, Start

Recon = Literal["l1", "l2", "smooth_l1"]


class ConvSizes(TypedDict):
    """Keyword arguments of the convolutional encoders and decoders."""

    width: int
    depth: int
    dilation_growth: int


class BaseTokenizerConfig(Config):
    """What every tokenizer has."""

    width: int = Field(default=512, ge=1)
    """Channels of the convolutions."""
    depth: int = Field(default=3, ge=1, le=32)
    """Residual blocks per resolution."""
    dilation_growth: int = Field(default=3, ge=1, le=16)
    code_dim: int = Field(default=512, ge=1)
    recon: Recon = "l2"
    velocity_weight: float = Field(default=0.0, ge=0)
    """Weight of the same reconstruction error between frame-to-frame differences."""
    root_gain: float = Field(default=1.0, gt=0)
    """How much more the root's columns count than others [ours]; see `layers/basis.py`."""
    finger_gain: float = Field(default=0.0, ge=0)
    """Above 0, fingers count by how they bend, in bone lengths times this [ours]; see `layers/basis.py`."""

    def conv_sizes(self) -> ConvSizes:
        """Keyword arguments of encoders and decoders."""
        return {"width": self.width, "depth": self.depth, "dilation_growth": self.dilation_growth}

    def commitment(self) -> float:
        """Weight of the quantizers' penalty; 0 for quantizers without one."""
        return 0.0


class EmaTokenizerConfig(BaseTokenizerConfig):
    """What tokenizers with learnt codebooks share."""

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


class H2VQConfig(EmaTokenizerConfig):
    """Holistic Hierarchical VQ: a hand codebook at 4x, a body codebook at 2x."""

    kind: Literal["h2vq"] = "h2vq"
    part: Literal["bodyhand"] = "bodyhand"


class VqConfig(EmaTokenizerConfig):
    """Vanilla VQ: one codebook at 4x."""

    kind: Literal["vq"] = "vq"
    part: Part = "bodyhand"


class RvqConfig(EmaTokenizerConfig):
    """Residual VQ: `levels` codebooks at 4x. With `part: face` it is HumanTOMATO's face tokenizer (B.4)."""

    kind: Literal["rvq"] = "rvq"
    part: Part = "bodyhand"
    levels: int = Field(default=2, ge=1)


class SeparateConfig(EmaTokenizerConfig):
    """Body and hand modelled apart (Tables 5 and 22): H2VQ's rates, but neither knows of the other."""

    kind: Literal["separate"] = "separate"
    part: Literal["bodyhand"] = "bodyhand"


class FsqConfig(BaseTokenizerConfig):
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


class MqConfig(BaseTokenizerConfig):
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
    """How the codebook is learnt: by gradient (the paper), or by moving averages with Code Reset [ours]."""
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


class Tm2tConfig(MqConfig):
    """TM2T's tokenizer: its residual blocks are behind the codebook, in the decoder."""

    kind: Literal["tm2t"] = "tm2t"  # type: ignore[assignment]
    recon: Recon = "l1"
    depth: int = Field(default=3, ge=0, le=32)
    """Residual blocks of the decoder; the encoder has one after each layer that changes the rate."""
    num_codes: int = Field(default=1024, ge=2)
    quantizer: Literal["gradient"] = "gradient"


AnyTokenizerConfig = H2VQConfig | VqConfig | RvqConfig | SeparateConfig | FsqConfig | MqConfig | Tm2tConfig
_KINDS: dict[str, type[AnyTokenizerConfig]] = {
    "h2vq": H2VQConfig,
    "vq": VqConfig,
    "rvq": RvqConfig,
    "separate": SeparateConfig,
    "fsq": FsqConfig,
    "mq": MqConfig,
    "tm2t": Tm2tConfig,
}


def parse_tokenizer(data: dict[str, Any], where: str) -> AnyTokenizerConfig:
    """The config of any tokenizer, told apart by `kind`; a `UserError` names `where` and the key."""
    kind = str(data.get("kind"))
    if kind not in _KINDS:
        raise UserError(f"{where}: no tokenizer of kind '{kind}'; known: {', '.join(_KINDS)}")
    return _KINDS[kind].parse(data, where)
