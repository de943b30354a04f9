"""TMA: text and motion in one latent space (HumanTOMATO section 3.5 and appendix D; TEMOS, TMR).

Three transformers. The motion encoder and the text encoder each read their sequence after two learned tokens
whose outputs are the mean and the log-variance of a Gaussian latent; the motion decoder writes a motion from
one latent.

Notable choices:
- The decoder puts the latent in front of the frame queries and lets them attend to it. TEMOS attends to a
  one-token memory by cross-attention, which is the same information path with one softmax over a single key.
- `frame_stride` n feeds and reconstructs every n-th frame. 1 is the paper; small CPU runs take 2 to 4.
- Gains [ours] let it read and reconstruct motion in the coordinates of `Basis`, where a hand's shape is the
  same numbers wherever the hand is; in the paper's features small networks do not see it.
- `text_noise` and `text_dropout` [ours] keep the text encoder from learning a few wordings by heart: small
  sets repeat the same wordings again and again, and users choose others.

Legend: B batch, T frames, D motion features, S text tokens, E text width, Z latent width.
"""

from __future__ import annotations

from typing import Self

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.models.layers.basis import Basis
from motionloom.models.layers.linear import Linear
from motionloom.models.layers.transformer import Norm, StackConfig, Transformer, length_mask, sinusoid


class TmaConfig(StackConfig):
    """Sizes of TMA; the defaults are the paper config."""

    latent: int = Field(default=256, ge=2)
    layers: int = Field(default=6, ge=1)
    heads: int = Field(default=4, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    norm: Norm = "pre"
    """`post` is TEMOS' and TMR's; `pre` needs no warm-up [ours]."""
    frame_stride: int = Field(default=1, ge=1)
    """Every n-th frame is fed and reconstructed; 1 is the paper."""
    root_gain: float = Field(default=1.0, gt=0)
    """Weight of the root's columns relative to others [ours]; see `layers/basis.py`."""
    finger_gain: float = Field(default=0.0, ge=0)
    """Above 0, fingers count by how they bend, in bone lengths times this [ours]; see `layers/basis.py`."""
    text_dropout: float | None = Field(default=None, ge=0, lt=1)
    """Dropout of the text encoder; null is `dropout`, as for the others [ours]."""
    text_noise: float = Field(default=0.0, ge=0)
    """Width of Gaussian noise on the text features in training, in root mean squares of each caption's own
    features [ours]."""

    @property
    def width(self) -> tuple[str, int]:
        """The latent is the width of all three transformers."""
        return "latent", self.latent


class GaussianEncoder(nn.Module):
    """Sequence -> mean and log-variance, through a mu token and a sigma token in front of the sequence."""

    def __init__(self, config: TmaConfig, dim: int) -> None:
        super().__init__()
        self.project = Linear(dim, config.latent)
        self.queries = nn.Parameter(torch.randn(2, config.latent) * config.latent**-0.5)
        self.stack = _stack(config)

    def forward(self, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """x [B, L, dim], mask bool [B, L] (True = real) -> (mu [B, Z], logvar [B, Z])."""
        x = self.project(x)
        x = torch.cat([self.queries.to(x.dtype).expand(len(x), -1, -1), x], dim=1)
        x = x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype)
        visible = torch.cat([mask.new_ones(len(mask), 2), mask], dim=1)
        x = self.stack(x, visible)
        return x[:, 0].float(), x[:, 1].float()


class MotionDecoder(nn.Module):
    """One latent -> a motion, all frames at once."""

    def __init__(self, config: TmaConfig, dim: int) -> None:
        super().__init__()
        self.latent = nn.Linear(config.latent, config.latent)
        self.stack = _stack(config)
        self.out = Linear(config.latent, dim)

    def forward(self, z: Tensor, mask: Tensor) -> Tensor:
        """z [B, Z], mask bool [B, L] -> [B, L, D], zero where masked."""
        head = self.latent(z.to(self.latent.weight.dtype))[:, None]
        frames = sinusoid(mask.shape[1], head.shape[2], z.device).to(head.dtype).expand(len(z), -1, -1)
        visible = torch.cat([mask.new_ones(len(mask), 1), mask], dim=1)
        x = self.stack(torch.cat([head, frames], dim=1), visible)[:, 1:]
        out: Tensor = self.out(x).float()
        return out * mask[..., None]


def noisy(tokens: Tensor, mask: Tensor, scale: float) -> Tensor:
    """tokens [B, S, E] with Gaussian noise, `scale` root mean squares of each caption's own features wide.

    The features of different encoders differ in size, so an absolute width would mean nothing. What is masked
    (bool [B, S], True = real) does not count.
    """
    squares = tokens.square().mean(-1).masked_fill(~mask, 0.0).sum(1) / mask.sum(1).clamp(min=1)
    return tokens + scale * squares.sqrt()[:, None, None] * torch.randn_like(tokens)


def _stack(config: TmaConfig) -> Transformer:
    return Transformer(config, config.layers, attention_dropout=config.attention_dropout, norm=config.norm)


class Tma(nn.Module):
    """Motion encoder, text encoder and motion decoder over one latent space.

    Args:
        motion_dim: D.
        text_dim: E.
        basis: Coordinates of the motion, as `of_layout` makes them; None = the features themselves.
    """

    def __init__(self, config: TmaConfig, motion_dim: int, text_dim: int, basis: Basis | None = None) -> None:
        super().__init__()
        if basis is None and (config.root_gain != 1 or config.finger_gain):
            raise ValueError("gains need the layout of the motion; build this TMA with Tma.of_layout")
        self.config = config
        self.motion_dim = motion_dim
        self.text_dim = text_dim
        self.basis = basis
        self.motion_encoder = GaussianEncoder(config, motion_dim)
        words = config.dropout if config.text_dropout is None else config.text_dropout
        self.text_encoder = GaussianEncoder(config.model_copy(update={"dropout": words}), text_dim)
        self.motion_decoder = MotionDecoder(config, motion_dim)

    @classmethod
    def of_layout(cls, config: TmaConfig, layout: MotionLayout, part: Part, text_dim: int) -> Self:
        """For one part of the clips of a layout; `basis.learn` then takes how its columns are normalised."""
        columns = layout.part(part)
        basis = None
        if config.root_gain != 1 or config.finger_gain:
            basis = Basis(layout, columns, root_gain=config.root_gain, finger_gain=config.finger_gain)
        return cls(config, len(columns), text_dim, basis)

    def coordinates(self, x: Tensor, present: Tensor | None = None) -> Tensor:
        """Motion [B, T, D] in the coordinates that are encoded and reconstructed; 0, the mean, in the columns
        that a clip does not hold (`present` bool [B, D]; None = all are present).
        """
        out = x if self.basis is None else self.basis.encode(x)
        return out if present is None else out.masked_fill(~present[:, None], 0.0)

    def subsample(self, x: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Every `frame_stride`-th frame of x [B, T, D], and the lengths in such frames (rounded up)."""
        stride = self.config.frame_stride
        return x[:, ::stride], (length + stride - 1) // stride

    def encode_motion(
        self, x: Tensor, length: Tensor, present: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Encode x [B, T, D] of length int64 [B]; `present` as in `coordinates` -> (mu, logvar) [B, Z]."""
        if x.shape[-1] != self.motion_dim:
            raise ValueError(f"TMA was built for {self.motion_dim} motion features, got {x.shape[-1]}")
        x, length = self.subsample(x, length)
        mu, logvar = self.motion_encoder(self.coordinates(x, present), length_mask(length, x.shape[1]))
        return mu, logvar

    def encode_text(self, tokens: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """tokens [B, S, E] text features, mask bool [B, S] -> (mu, logvar), float32 [B, Z]."""
        if tokens.shape[-1] != self.text_dim:
            raise ValueError(f"TMA was built for {self.text_dim} text features, got {tokens.shape[-1]}")
        if self.training and self.config.text_noise:
            tokens = noisy(tokens, mask, self.config.text_noise)
        mu, logvar = self.text_encoder(tokens, mask)
        return mu, logvar

    def decode(self, z: Tensor, length: Tensor, frames: int) -> Tensor:
        """Z [B, Z] -> features [B, ceil(frames / stride), D], every `frame_stride`-th; zero past `length`."""
        coordinates = self.decode_coordinates(z, length, frames)
        if self.basis is None:
            return coordinates
        stride = self.config.frame_stride
        mask = length_mask((length + stride - 1) // stride, coordinates.shape[1])
        return self.basis.decode(coordinates) * mask[..., None]

    def decode_coordinates(self, z: Tensor, length: Tensor, frames: int) -> Tensor:
        """`decode`, in the coordinates of `coordinates`: the reconstruction that the loss compares."""
        stride = self.config.frame_stride
        mask = length_mask((length + stride - 1) // stride, (frames + stride - 1) // stride)
        out: Tensor = self.motion_decoder(z, mask)
        return out
