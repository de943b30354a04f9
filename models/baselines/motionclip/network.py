"""MotionCLIP's auto-encoder, whose one latent lies where a frozen text encoder puts what is said of it.

Encoder and decoder are ACTOR's: two learnt queries in front of the frames, of which the first becomes the
latent (there is no sampling; the second is read along, as published), and a decoder whose queries are
positions alone.

Published sizes: 16.90 M and 25.31 M parameters, for 25 x 6 columns of UDE's layout `smpl75` (`sixd.py`).

The latent is scaled to length sqrt(C) before it is decoded **[ours]**: the training says where it points and
not how long it is, and the published decoder reads texts as CLIP left them.

Legend: B batch, T frames, D motion features, C width of latent and text.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.schema import Config
from motionloom.models.baselines.motionclip.sixd import SixD
from motionloom.models.layers.transformer import StackConfig, Transformer, sinusoid


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
    """Weights; the defaults are the published ones, which are of 6-D rotations and metres. Normalised columns
    have larger errors.
    """

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
        seen = x if self.sixd is None else self.sixd.encode(x)
        return seen if present is None or self.sixd else seen.masked_fill(~present[:, None], 0.0)

    def encode(self, seen: Tensor, mask: Tensor) -> Tensor:
        """Coordinates [B, T, D], mask bool [B, T] (True = real) -> latents [B, C] of any length."""
        frames = self.enter(seen)
        x = torch.cat([self.queries.to(frames.dtype).expand(len(seen), -1, -1), frames], dim=1)
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

    def features(self, seen: Tensor) -> Tensor:
        """Coordinates [B, T, D] -> normalised motion [B, T, motion_dim]."""
        return seen if self.sixd is None else self.sixd.decode(seen)


def _stack(config: MotionClipConfig, *, memory: bool = False) -> Transformer:
    return Transformer(
        config, config.layers, attention_dropout=config.attention_dropout, norm="post", memory=memory
    )
