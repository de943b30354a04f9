"""`MotionDiffusion`: a transformer encoder that denoises a motion given a text (HumanTOMATO B.5.2, MDM).

The condition, projected text plus embedded time step, is one token in front of the frames; every frame is
one more token. The output at the frames is the clean motion (or the noise, as the schedule predicts).
`condition_dropout` hides the text from some samples, for classifier-free guidance: zeros are projected in its
place. With `norm: post` it is MDM's `trans_enc`.

Legend: B batch, T frames, D motion features, E text width.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from motionloom.models.diffusion.observed import observed_width
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
    observed: float = Field(default=0.0, ge=0, le=1)
    """Share of samples of which the network is shown a part, as columns beside the noise, so that it learns
    to fill in the rest [ours]; 0 is MDM's, without these columns."""
    quieted: bool = False
    """Enter noisy frames as the best linear guess of the motion in them, which is next to nothing where they
    are next to noise [ours]: small networks take long to learn that. False is MDM's."""
    spread: bool = False
    """Add the condition to every frame too, the text as long as its width's root [ours]: it comes through
    where frames are next to noise. False is MDM's."""
    frames_per_token: int = Field(default=1, ge=1)
    """Frames that are one token together [ours]; 1 is MDM's."""
    velocity_weight: float = Field(default=0.0, ge=0)
    """Weight of the same error between frame-to-frame differences, which makes motion smoother; 0 is MDM's
    for features."""
    schedule: ScheduleConfig = ScheduleConfig()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.schedule.predicts != "sample" and (self.velocity_weight or self.quieted):
            raise ValueError("velocity_weight and quieted are for schedule: {predicts: sample}")
        return self


class MotionDiffusion(nn.Module):
    """Denoiser of motions [B, T, D] normalised, given one text vector [B, E] each."""

    share: Tensor
    """Of a unit motion in what it is noised to, by time step [steps]; ones unless `quieted`."""

    def __init__(self, config: DiffusionConfig, motion_dim: int, text_dim: int) -> None:
        super().__init__()
        self.config = config
        self.motion_dim = motion_dim
        self.text_dim = text_dim
        share = torch.ones(config.schedule.steps)
        if config.quieted:
            share = torch.from_numpy(np.cumprod(1 - config.schedule.beta_table()) ** 0.5).float()
        self.register_buffer("share", share, persistent=False)
        per = config.frames_per_token
        shown = per * observed_width(motion_dim)
        self.enter = nn.Linear(per * motion_dim, config.dim)
        self.seen = nn.Linear(shown, config.dim, bias=False) if config.observed else None
        self.text = nn.Linear(text_dim, config.dim)
        self.time = nn.Sequential(
            nn.Linear(config.dim, config.dim), nn.SiLU(), nn.Linear(config.dim, config.dim)
        )
        self.dropout = nn.Dropout(config.dropout)
        self.stack = Transformer(config, config.layers, norm=config.norm)
        self.leave = nn.Linear(config.dim, per * motion_dim)

    def forward(
        self,
        noisy: Tensor,
        step: Tensor,
        text: Tensor,
        mask: Tensor,
        conditioned: Tensor,
        seen: Tensor | None = None,
    ) -> Tensor:
        """The clean motion (or the noise) of `noisy`; zero where masked.

        Args:
            noisy: [B, T, D].
            step: int64 [B], time step of each sample.
            text: [B, E].
            mask: bool [B, T], True = real frame.
            conditioned: bool [B], False hides the text.
            seen: [B, T, 2 D + 6], what is known of the motion (`observed.py`); None is nothing. Networks
                without such columns take no notice of it.
        """
        time = self.time(waves(step, self.config.dim).to(self.text.weight.dtype))
        text = text * conditioned[:, None]
        condition = self.text(text * self.text_dim**0.5 if self.config.spread else text) + time
        if self.config.quieted:
            noisy = noisy * self.share[step][:, None, None].to(noisy.dtype)
        frames = self.enter(self._tokens(noisy * mask[..., None]))
        if self.config.spread:
            frames = frames + condition[:, None].to(frames.dtype)
        if self.seen is not None and seen is not None:
            frames = frames + self.seen(self._tokens(seen.to(frames.dtype)))
        x = torch.cat([condition[:, None].to(frames.dtype), frames], dim=1)
        x = self.dropout(x + sinusoid(x.shape[1], x.shape[2], x.device).to(x.dtype))
        visible = torch.cat([mask.new_ones(len(mask), 1), self._tokens(mask[..., None]).any(-1)], dim=1)
        out: Tensor = self.leave(self.stack(x, visible)[:, 1:])
        out = out.view(len(out), -1, self.motion_dim)[:, : mask.shape[1]]
        return out.to(torch.promote_types(out.dtype, torch.float32)) * mask[..., None]

    def _tokens(self, frames: Tensor) -> Tensor:
        """[B, T, D] -> [B, T / k, k D] of k frames a token, with zeros after the last."""
        per = self.config.frames_per_token
        whole = torch.nn.functional.pad(frames, (0, 0, 0, -frames.shape[1] % per))
        return whole.reshape(len(frames), -1, per * frames.shape[2])


def step_waves(step: Tensor, dim: int) -> Tensor:
    """Embedding [B, dim] of time steps [B]: all sines, then all cosines."""
    half = torch.arange(dim // 2, device=step.device)
    angle = step[:, None].float() * torch.exp(-math.log(10_000.0) * half / (dim // 2))
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
