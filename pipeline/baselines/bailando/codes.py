"""`DanceVq`: joint positions to the codes of two halves of the body, and back (Bailando, section 3.1).

Hips, legs and feet are the lower half, all other joints the upper one. Each has an encoder, a codebook learnt
by moving averages and a decoder of its own. They see poses: the root is taken from every joint. Where the
root goes is decoded from the codes of the lower half, as steps from frame to frame, by a decoder that is
trained when all else is.

Nothing is normalised: positions are metres.

Legend: B batch, T frames, L codes, N joints.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.features.running_sum import running_sum
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.models.layers.conv import Conv, ConvTranspose, ResidualBlock, start_weights
from motionloom.models.quantize.base import QuantizerConfig
from motionloom.models.quantize.ema import EmaQuantizer

_SMPL = Skeleton.named("smpl22")
_LOWER = [0, *(_SMPL.index(f"{side}_{joint}") for joint in ("hip", "knee", "ankle", "foot")
               for side in ("left", "right"))]  # fmt: skip
HALVES = ("up", "down")


class DanceVqConfig(Config):
    """Sizes and weights; the defaults are the published ones, of 60 frames a second."""

    width: int = Field(default=512, ge=1)
    depth: int = Field(default=3, ge=1, le=16)
    """Residual blocks at each rate."""
    dilation_growth: int = Field(default=3, ge=1, le=16)
    halvings: int = Field(default=3, ge=1, le=6)
    """A code stands for two to the power of this many frames."""
    code_dim: int = Field(default=512, ge=1)
    num_codes: int = Field(default=512, ge=2)
    decay: float = Field(default=0.99, gt=0, lt=1)
    reset_below: float = Field(default=1.0, gt=0)
    velocity_weight: float = Field(default=1.0, ge=0)
    acceleration_weight: float = Field(default=1.0, ge=0)
    commitment_weight: float = Field(default=0.02, ge=0)

    @property
    def code_frames(self) -> int:
        """Frames of one code."""
        return int(2**self.halvings)


class HalfOutput(NamedTuple):
    """The output of one half."""

    input: Tensor
    """[B, T, 3 n], its joints from the root."""
    reconstruction: Tensor
    penalty: Tensor
    codes: Tensor
    """int64 [B, L]."""
    metrics: dict[str, Tensor]


class _Stack(nn.Sequential):
    """Residual blocks, their dilations in the order given."""

    def __init__(self, width: int, dilations: list[int]) -> None:
        super().__init__(*(ResidualBlock(width, dilation) for dilation in dilations))

    def forward(self, x: Tensor) -> Tensor:
        for block in self:
            x = block(x, None)
        return x


def _encoder(config: DanceVqConfig, dim: int) -> nn.Sequential:
    """Frames [B, T, dim] to latents [B, L, code_dim]."""
    parts: list[nn.Module] = []
    for level in range(config.halvings):
        parts.append(Conv(config.width if level else dim, config.width, 4, stride=2, padding=1))
        parts.append(_Stack(config.width, _dilations(config)))
    return nn.Sequential(*parts, Conv(config.width, config.code_dim, 3, padding=1))


def _decoder(config: DanceVqConfig, dim: int) -> nn.Sequential:
    """Code vectors [B, L, code_dim] to frames [B, T, dim]."""
    parts: list[nn.Module] = [Conv(config.code_dim, config.width, 3, padding=1)]
    for level in range(config.halvings):
        last = level == config.halvings - 1
        parts.append(_Stack(config.width, _dilations(config)[::-1]))
        out = config.code_dim if last else config.width
        parts.append(ConvTranspose(config.width, out, 4, stride=2, padding=1))
    return nn.Sequential(*parts, Conv(config.code_dim, dim, 3, padding=1))


@torch.no_grad()
def _start_decoder(decoder: nn.Sequential) -> None:
    """Fresh weights; what comes out is near zero at first."""
    start_weights(decoder)
    last = decoder[-1]
    assert isinstance(last, Conv)
    last.weight.mul_(0.1)


def _dilations(config: DanceVqConfig) -> list[int]:
    return [config.dilation_growth**i for i in range(config.depth)]


class HalfVq(nn.Module):
    """One half of the body, [B, T, 3 n] to codes [B, L] and back."""

    def __init__(self, config: DanceVqConfig, joints: int, *, salt: int) -> None:
        super().__init__()
        self.encoder = _encoder(config, 3 * joints)
        self.quantizer = EmaQuantizer(
            QuantizerConfig(
                num_codes=config.num_codes, dim=config.code_dim, decay=config.decay,
                reset_below=config.reset_below,
            ),
            salt=salt,
        )  # fmt: skip
        self.decoder = _decoder(config, 3 * joints)
        start_weights(self.encoder)
        _start_decoder(self.decoder)

    def forward(self, x: Tensor) -> HalfOutput:
        """Training updates the codebook."""
        out = self.quantizer(self.encoder(x))
        made = decoded(self.decoder, out.quantized)
        return HalfOutput(x, made, out.penalty, out.codes, out.metrics)


def places(columns: Tensor) -> Tensor:
    """Columns [B, T, 3 N] -> joints [B, T, N, 3]."""
    return columns.reshape(*columns.shape[:2], -1, 3)


def decoded(decoder: nn.Sequential, vectors: Tensor) -> Tensor:
    """Code vectors [B, L, d] through a decoder, [B, T, D]."""
    weights = next(decoder.parameters())  # codebooks are float32 whatever the network is
    out: Tensor = decoder(vectors.to(weights.dtype))
    return out


class DanceVq(nn.Module):
    """Joints [B, T, N, 3] in metres to codes of both halves and back; T is a multiple of `code_frames`.

    Args:
        joints: N, of which the first 22 are those of `smpl22`.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, config: DanceVqConfig, joints: int) -> None:
        super().__init__()
        self.config = config
        self.joints = joints
        # On the network's device: lists would be sent there at every use.
        upper = [joint for joint in range(joints) if joint not in _LOWER]
        self.register_buffer("lower", torch.tensor(_LOWER), persistent=False)
        self.register_buffer("upper", torch.tensor(upper), persistent=False)
        self.up = HalfVq(config, len(self.upper), salt=0)
        self.down = HalfVq(config, len(self.lower), salt=1)
        self.root = _decoder(config, 3)
        _start_decoder(self.root)

    @property
    def halves(self) -> dict[str, HalfVq]:
        return {"up": self.up, "down": self.down}

    def poses(self, joints: Tensor) -> dict[str, Tensor]:
        """The halves' joints from the root, [B, T, 3 n]; the root itself is 0."""
        local = joints - joints[:, :, :1]
        return {"up": local[:, :, self.upper].flatten(2), "down": local[:, :, self.lower].flatten(2)}

    def forward(self, joints: Tensor) -> dict[str, HalfOutput]:
        """Both halves through their codes."""
        return {name: self.halves[name](x) for name, x in self.poses(joints).items()}

    def steps(self, codes: Tensor) -> Tensor:
        """Steps of the root to the next frame [B, T, 3], of the codes [B, L] of the lower half."""
        return decoded(self.root, self.down.quantizer.vectors(codes))

    @torch.no_grad()
    def encode(self, joints: Tensor) -> Tensor:
        """Codes int64 [B, L, 2] of both halves; never updates a codebook."""
        return torch.stack(
            [
                self.halves[name].quantizer(self.halves[name].encoder(x), update=False).codes
                for name, x in self.poses(joints).items()
            ],
            dim=-1,
        )

    @torch.no_grad()
    def decode(self, codes: Tensor) -> Tensor:
        """Joints [B, T, N, 3] of codes [B, L, 2]; the root starts at the origin."""
        made = {
            name: places(decoded(half.decoder, half.quantizer.vectors(codes[..., k])))
            for k, (name, half) in enumerate(self.halves.items())
        }
        joints = made["up"].new_empty(*made["up"].shape[:2], self.joints, 3)
        joints[:, :, self.upper] = made["up"]
        joints[:, :, self.lower] = made["down"]
        steps = self.steps(codes[..., 1])
        way = torch.cat([torch.zeros_like(steps[:, :1]), running_sum(steps[:, :-1], 1)], dim=1)
        # What the lower half says of its root is an error: it was 0.
        joints[:, :, 0] = 0.0
        return joints + way[:, :, None]
