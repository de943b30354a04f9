"""MLD's two networks: an auto-encoder of motion by one latent or a few, and a denoiser of those latents.

Both are transformers in a U (`SkipTransformer`) with learnt positions. The encoder reads two tokens for each
latent in front of the frames, whose outputs are its mean and the logarithm of its variance; the decoder's
queries are positions alone and attend to the latents.

Published sizes: 18.03 M and 8.35 M parameters. Of the latter 128,000 are a table of positions that the
published network never reads, and this one does not have. The published means of losses run over padding
too, where both sides are zero; these run over real frames alone [ours].

Legend: B batch, T frames, D motion features, K latents, C width, E text width.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from pydantic import Field, model_validator
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.features.torch_joints import present_joints, torch_joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.diffusion.network import step_waves
from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.layers.transformer import SkipTransformer, StackConfig, length_mask
from motionloom.models.training.distributed import masked_mean


class UConfig(StackConfig):
    """Sizes of a U; the defaults are the published ones."""

    dim: int = Field(default=256, ge=2, multiple_of=2)
    layers: int = Field(default=9, ge=1)
    """Odd: as many lead down into the U as out of it, and one is at the bottom."""
    heads: int = Field(default=4, ge=1)
    attention_dropout: float = Field(default=0.1, ge=0, lt=1)
    positions: int = Field(default=500, ge=8)
    """Longest sequence that there are learnt positions for, the tokens in front of the frames included."""

    @model_validator(mode="after")
    def _has_a_bottom(self) -> UConfig:
        if self.layers % 2 == 0:
            raise ValueError(f"layers {self.layers} must be odd: a U has one layer at its bottom")
        return self


class MotionVaeConfig(UConfig):
    """Sizes of the auto-encoder."""

    latent_tokens: int = Field(default=1, ge=1, le=64)
    """Latents of a motion; the paper's are 1 (its main results) and up to 10, 7 of them best rebuilt."""


class LatentDiffusionConfig(UConfig):
    """Sizes of the denoiser, which is as wide as the latents."""

    condition_dropout: float = Field(default=0.1, ge=0, lt=1)
    """Share of samples trained with an empty text; 0 turns guidance off."""
    time_waves: int = Field(default=768, ge=2, multiple_of=2)
    """Width of the embedding of a time step before it is projected."""
    schedule: ScheduleConfig = ScheduleConfig(
        betas="scaled_linear", predicts="epsilon", steps_offset=1, set_alpha_to_one=False
    )


class Positions(nn.Module):
    """Learnt positions, added to a sequence."""

    def __init__(self, config: UConfig) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.rand(config.positions, 1, config.dim))

    def forward(self, x: Tensor) -> Tensor:
        """x [B, L, C]."""
        return x + self.table[: x.shape[1], 0].to(x.dtype)


class MotionVae(nn.Module):
    """Motion [B, T, D] normalised <-> latents [B, K, C]."""

    def __init__(self, config: MotionVaeConfig, motion_dim: int) -> None:
        super().__init__()
        self.config = config
        self.motion_dim = motion_dim
        self.queries = nn.Parameter(torch.randn(2 * config.latent_tokens, config.dim))
        self.enter = nn.Linear(motion_dim, config.dim)
        self.encoder_positions = Positions(config)
        self.encoder = _stack(config)
        self.decoder_positions = Positions(config)
        self.decoder = _stack(config, memory=True)
        self.leave = nn.Linear(config.dim, motion_dim)

    def encode(self, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """x [B, T, D], mask bool [B, T] (True = real) -> mean and log-variance, [B, K, C] each."""
        frames = self.enter(x)
        tokens = self.queries.to(frames.dtype).expand(len(x), -1, -1)
        visible = torch.cat([mask.new_ones(len(mask), tokens.shape[1]), mask], dim=1)
        read = self.encoder(self.encoder_positions(torch.cat([tokens, frames], dim=1)), visible)
        mu, logvar = read[:, : tokens.shape[1]].float().chunk(2, dim=1)
        return mu, logvar

    def decode(self, z: Tensor, mask: Tensor) -> Tensor:
        """z [B, K, C], mask bool [B, T] -> [B, T, D], zero where masked."""
        z = z.to(self.leave.weight.dtype)
        queries = self.decoder_positions(z.new_zeros(*mask.shape, z.shape[2]))
        out: Tensor = self.leave(self.decoder(queries, mask, memory=z)).float()
        return out * mask[..., None]

    def reconstruct(self, x: Tensor, length: Tensor, present: Tensor | None = None) -> Tensor:
        """Motion [B, T, D] of `length` frames by its mean latents and back; what a clip does not hold
        (`present` bool [B, D], None = all are) is read as 0, the mean.
        """
        mask = length_mask(length, x.shape[1])
        return self.decode(self.encode(mask_missing(x, present), mask)[0], mask)


class LoadedMotionVae(NamedTuple):
    """A trained auto-encoder of body and hands (MLD), which writes at most `max_frames`."""

    net: MotionVae
    layout: MotionLayout
    max_frames: int


class LatentDenoiser(nn.Module):
    """Predicts the noise (or the clean latents) of noisy latents [B, K, C], given one text vector each."""

    empty: Tensor

    def __init__(self, config: LatentDiffusionConfig, latent_tokens: int, text_dim: int) -> None:
        super().__init__()
        self.config = config
        self.latent_tokens = latent_tokens
        self.text_dim = text_dim
        self.time = nn.Sequential(
            nn.Linear(config.time_waves, config.dim), nn.SiLU(), nn.Linear(config.dim, config.dim)
        )
        self.text = nn.Sequential(nn.ReLU(), nn.Linear(text_dim, config.dim))
        self.positions = Positions(config)
        self.stack = _stack(config)
        self.register_buffer("empty", torch.zeros(text_dim))
        """Embedding of the empty text, which stands where the text is hidden."""

    def forward(self, noisy: Tensor, step: Tensor, text: Tensor, conditioned: Tensor) -> Tensor:
        """noisy [B, K, C], step int64 [B], text [B, E], conditioned bool [B] (False hides the text)."""
        dtype = self.positions.table.dtype
        words = torch.where(conditioned[:, None], text.to(dtype), self.empty.to(dtype))
        # Cosines come first.
        time = step_waves(step, self.config.time_waves).roll(self.config.time_waves // 2, dims=1).to(dtype)
        tokens = torch.stack([self.time(time), self.text(words)], dim=1)
        x = torch.cat([noisy.to(tokens.dtype), tokens], dim=1)
        out: Tensor = self.stack(self.positions(x))
        return out[:, : noisy.shape[1]].float()


def mask_missing(x: Tensor, present: Tensor | None) -> Tensor:
    """Motion [B, T, D] with 0, the mean, in the columns that a clip does not hold (bool [B, D])."""
    return x if present is None else x.masked_fill(~present[:, None], 0.0)


def _stack(config: UConfig, *, memory: bool = False) -> SkipTransformer:
    return SkipTransformer(config, config.layers, attention_dropout=config.attention_dropout, memory=memory)


class MotionVaeLossConfig(Config):
    """Weights; the defaults are the published ones."""

    features: float = Field(default=1.0, ge=0)
    joints: float = Field(default=1.0, ge=0)
    kl: float = Field(default=1e-4, ge=0)


def smooth_l1_of_joints(
    pred: Tensor, target: Tensor, layout: MotionLayout, mask: Tensor, present: Tensor | None = None
) -> Tensor:
    """SmoothL1 of the joints in metres, mean over real frames and the joints that each clip holds.

    pred, target [B, T, D] in their own units; mask bool [B, T]; present bool [B, D] (None = all).
    """
    with torch.autocast(pred.device.type, enabled=False):
        found, wanted = (torch_joints_of(motion, layout) for motion in (pred.float(), target.float()))
        error = F.smooth_l1_loss(found, wanted, reduction="none").flatten(2)
        held = None if present is None else present_joints(present, layout).repeat_interleave(3, dim=1)
        return masked_mean(error, mask, held)
