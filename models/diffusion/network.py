"""`MotionDiffusion`: a transformer encoder that denoises a motion given a text (HumanTOMATO B.5.2, MDM).

The condition, projected text plus embedded time step, is one token in front of the frames; every frame is
one more token. The output at the frames is the clean motion (or the noise, as the schedule predicts).
`condition_dropout` hides the text from some samples, for classifier-free guidance: zeros are projected in its
place. With `norm: post` it is MDM's `trans_enc`.

Legend: B batch, T frames, D motion features, E text width.
"""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.layers.transformer import Norm, StackConfig, Transformer, sinusoid, waves


class DiffusionConfig(StackConfig):
    """Sizes; the defaults are MDM's, "all parameter settings follow" it (B.5.2)."""

    dim: int = Field(default=512, ge=2, multiple_of=2)
    layers: int = Field(default=8, ge=1)
    heads: int = Field(default=4, ge=1)
    norm: Norm = "pre"
    """`post` is MDM's; `pre` needs no warm-up [ours]."""
    condition_dropout: float = Field(default=0.1, ge=0, lt=1)
    """Share of samples trained without text; 0 turns guidance off."""
    schedule: ScheduleConfig = ScheduleConfig()


class MotionDiffusion(nn.Module):
    """Denoiser of motions [B, T, D] normalised, given one text vector [B, E] each."""

    def __init__(self, config: DiffusionConfig, motion_dim: int, text_dim: int) -> None:
        super().__init__()
        self.config = config
        self.motion_dim = motion_dim
        self.text_dim = text_dim
        self.enter = nn.Linear(motion_dim, config.dim)
        self.text = nn.Linear(text_dim, config.dim)
        self.time = nn.Sequential(
            nn.Linear(config.dim, config.dim), nn.SiLU(), nn.Linear(config.dim, config.dim)
        )
        self.dropout = nn.Dropout(config.dropout)
        self.stack = Transformer(config, config.layers, norm=config.norm)
        self.leave = nn.Linear(config.dim, motion_dim)

    def forward(self, noisy: Tensor, step: Tensor, text: Tensor, mask: Tensor, conditioned: Tensor) -> Tensor:
        """The clean motion (or the noise) of `noisy`; zero where masked.

        Args:
            noisy: [B, T, D].
            step: int64 [B], time step of each sample.
            text: [B, E].
            mask: bool [B, T], True = real frame.
            conditioned: bool [B], False hides the text.
        """
        time = self.time(waves(step, self.config.dim).to(self.text.weight.dtype))
        condition = self.text(text * conditioned[:, None]) + time
        frames = self.enter(noisy)
        x = torch.cat([condition[:, None].to(frames.dtype), frames], dim=1)
        x = self.dropout(x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype))
        visible = torch.cat([mask.new_ones(len(mask), 1), mask], dim=1)
        out: Tensor = self.leave(self.stack(x, visible)[:, 1:])
        return out.to(torch.promote_types(out.dtype, torch.float32)) * mask[..., None]


def step_waves(step: Tensor, dim: int) -> Tensor:
    """Embedding [B, dim] of time steps [B]: all sines, then all cosines."""
    half = torch.arange(dim // 2, device=step.device)
    angle = step[:, None].float() * torch.exp(-math.log(10_000.0) * half / (dim // 2))
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
