"""MotionCLIP's auto-encoder, whose latent is trained to equal a frozen text encoder's embedding.

Encoder and decoder are ACTOR's: two learnt queries in front of the frames, of which the first becomes the
latent (there is no sampling; the second is read along, as published), and a decoder whose queries are
positions alone. Published sizes: 16.90 M and 25.31 M parameters.

`SixD` reads UDE's layout `smpl75` as MotionCLIP does, 25 x 6: the first two columns of each joint's rotation,
and the translation, filled up with zeros.

The latent is scaled to length sqrt(C) before it is decoded [ours]: the training determines its direction and
not its length, and the published decoder reads texts as CLIP left them.

Legend: B batch, T frames, D motion features, C width of latent and text.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.features.torch_joints import torch_smpl_joints
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.transformer import StackConfig, Transformer, sinusoid


class SixD(nn.Module):
    """Normalised columns [..., 75] <-> [..., 150] in their own units."""

    mean: Tensor
    std: Tensor
    dim = 150

    def __init__(self, layout: MotionLayout) -> None:
        super().__init__()
        self.trans = layout.slice("trans")
        self.pose = layout.slice("pose")
        self.register_buffer("mean", torch.zeros(layout.dim))
        self.register_buffer("std", torch.ones(layout.dim))

    @torch.no_grad()
    def learn(self, mean: NDArray[np.floating], std: NDArray[np.floating]) -> None:
        """Statistics that normalise the columns, [75] each; saved with the weights."""
        self.mean.copy_(torch.as_tensor(mean))
        self.std.copy_(torch.as_tensor(std))

    def encode(self, x: Tensor) -> Tensor:
        """Normalised columns -> two columns of 24 rotations, one after the other, and the translation."""
        import roma

        values = x.to(torch.promote_types(x.dtype, torch.float32)) * self.std + self.mean
        turns = values[..., self.pose].reshape(*x.shape[:-1], 24, 3)
        two = roma.rotvec_to_rotmat(turns)[..., :2].transpose(-1, -2)
        trans = values[..., self.trans]
        return torch.cat([two.flatten(-3), trans, torch.zeros_like(trans)], dim=-1)

    def decode(self, coordinates: Tensor) -> Tensor:
        """The inverse of `encode`, of what is near rotations too."""
        import roma

        local, trans = self._parts(coordinates)
        turns: Tensor = roma.rotmat_to_rotvec(local).flatten(-2)
        values = turns.new_empty(*turns.shape[:-1], len(self.mean))
        values[..., self.pose] = turns
        values[..., self.trans] = trans
        return (values - self.mean) / self.std

    def joints(self, coordinates: Tensor) -> Tensor:
        """Joints [..., 22, 3] in metres."""
        return torch_smpl_joints(*self._parts(coordinates))

    def _parts(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations [..., 24, 3, 3] by Gram and Schmidt, and translations [..., 3]."""
        import roma

        two = coordinates[..., :144].reshape(*coordinates.shape[:-1], 24, 2, 3).transpose(-1, -2)
        return roma.special_gramschmidt(two), coordinates[..., 144:147]


class MotionClipConfig(StackConfig):
    """Sizes; the defaults are the published ones."""

    latent: int = Field(default=512, ge=2)
    """Width of everything, and of the text stage's sentence embeddings: CLIP ViT-B/32's is 512, MiniLM's
    384."""
    layers: int = Field(default=8, ge=1)
    heads: int = Field(default=4, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)

    @property
    def width(self) -> tuple[str, int]:
        return "latent", self.latent


class MotionClipLossConfig(Config):
    """Loss weights; the defaults are the published ones, for 6-D rotations and metres."""

    features: float = Field(default=100.0, ge=0)
    joints: float = Field(default=100.0, ge=0)
    velocities: float = Field(default=100.0, ge=0)
    text: float = Field(default=1.0, ge=0)


class MotionClip(nn.Module):
    """Motion [B, T, motion_dim] normalised <-> one latent [B, C].

    Args:
        sixd: Coordinates in which motion is read and written; None = the columns themselves.
    """

    def __init__(self, config: MotionClipConfig, motion_dim: int, sixd: SixD | None = None) -> None:
        super().__init__()
        self.config = config
        self.sixd = sixd
        dim = motion_dim if sixd is None else sixd.dim
        self.enter = nn.Linear(dim, config.latent)
        self.queries = nn.Parameter(torch.randn(2, config.latent))
        self.dropout = nn.Dropout(config.dropout)
        self.encoder = _stack(config)
        self.decoder = _stack(config, memory=True)
        self.leave = nn.Linear(config.latent, dim)

    def coordinates(self, x: Tensor, present: Tensor | None = None) -> Tensor:
        """Motion [B, T, motion_dim] as it is read and written, [B, T, D]; 0, the mean, in the columns that a
        clip does not hold (`present` bool [B, motion_dim]; None = all are).
        """
        if self.sixd is not None:
            return self.sixd.encode(x)
        return x if present is None else x.masked_fill(~present[:, None], 0.0)

    def encode(self, coordinates: Tensor, mask: Tensor) -> Tensor:
        """Coordinates [B, T, D], mask bool [B, T] (True = real) -> latents [B, C] of any length."""
        frames = self.enter(coordinates)
        x = torch.cat([self.queries.to(frames.dtype).expand(len(coordinates), -1, -1), frames], dim=1)
        x = self.dropout(x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype))
        visible = torch.cat([mask.new_ones(len(mask), 2), mask], dim=1)
        out: Tensor = self.encoder(x, visible)[:, 0]
        return out.float()

    def decode(self, z: Tensor, mask: Tensor) -> Tensor:
        """Latents or texts [B, C], mask bool [B, T] -> coordinates [B, T, D], zero where masked."""
        memory = F.normalize(z, dim=-1) * self.config.latent**0.5
        queries = sinusoid(mask.shape[1], z.shape[1], z.device).to(self.leave.weight.dtype)
        queries = self.dropout(queries.expand(len(z), -1, -1))
        made = self.decoder(queries, mask, memory=memory[:, None].to(queries.dtype))
        out: Tensor = self.leave(made).float()
        return out * mask[..., None]

    def features(self, coordinates: Tensor) -> Tensor:
        """Coordinates [B, T, D] -> normalised motion [B, T, motion_dim]."""
        return coordinates if self.sixd is None else self.sixd.decode(coordinates)


def _stack(config: MotionClipConfig, *, memory: bool = False) -> Transformer:
    return Transformer(
        config, config.layers, attention_dropout=config.attention_dropout, norm="post", memory=memory
    )
