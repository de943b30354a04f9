"""`TextDenoiser`: a network that turns noisy motion and a text into clean motion.

Sampling (`sampling.py`) and training (`module.py`) work with any such network.

Legend: B batch, T frames, D motion features, E text width.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from motionloom.models.diffusion.schedule import ScheduleConfig
from motionloom.models.layers.transformer import StackConfig


class TextDenoiserConfig(StackConfig):
    """Sizes; the defaults are MDM's, "all parameter settings follow" it (HumanTOMATO B.5.2)."""

    dim: int = Field(default=512, ge=2, multiple_of=2)
    layers: int = Field(default=8, ge=1)
    heads: int = Field(default=4, ge=1)
    condition_dropout: float = Field(default=0.1, ge=0, lt=1)
    """Share of samples trained without text; 0 turns guidance off."""
    schedule: ScheduleConfig = ScheduleConfig()

    @model_validator(mode="after")
    def _predicts_motion(self) -> Self:
        if self.schedule.predicts != "sample":
            raise ValueError("this network predicts the clean motion; set schedule: {predicts: sample}")
        return self


class TextDenoiser(nn.Module):
    """Predicts clean motions [B, T, D], normalised, given one text vector [B, E] each."""

    config: TextDenoiserConfig

    def __init__(self, config: TextDenoiserConfig, motion_dim: int, text_dim: int) -> None:
        super().__init__()
        self.config = config
        self.motion_dim = motion_dim
        self.text_dim = text_dim

    @abstractmethod
    def forward(self, noisy: Tensor, step: Tensor, text: Tensor, mask: Tensor, conditioned: Tensor) -> Tensor:
        """Return the clean motion of `noisy`, zero where masked.

        Args:
            noisy: [B, T, D].
            step: int64 [B], time step of each sample.
            text: [B, E].
            mask: bool [B, T], True = real frame.
            conditioned: bool [B], False hides the text.
        """


def time_embedding(dim: int) -> nn.Sequential:
    """MDM's network between the waves of a time step [B, dim] and its embedding [B, dim]."""
    return nn.Sequential(nn.Linear(dim, dim), nn.SiLU(), nn.Linear(dim, dim))


def step_waves(step: Tensor, dim: int) -> Tensor:
    """Embedding [B, dim] of time steps [B]: all sines, then all cosines."""
    half = torch.arange(dim // 2, device=step.device)
    angle = step[:, None].float() * torch.exp(-math.log(10_000.0) * half / (dim // 2))
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
