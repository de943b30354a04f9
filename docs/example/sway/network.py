"""The network: a sentence, noise and the time to motion."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.base.config import Config

WAVES = 8
"""Sines of time that the network reads; the slowest lasts 256 frames."""


class SwayNetConfig(Config):
    """Sizes of the network."""

    width: int = Field(64, ge=1)
    noise: int = Field(4, ge=1)
    """Numbers that tell two motions of one sentence apart."""


class Sway(nn.Module):
    """Sentence [B, E] and noise [B, Z] to motion [B, T, D], normalised."""

    def __init__(self, config: SwayNetConfig, text: int, motion: int) -> None:
        super().__init__()
        self.noise = config.noise
        inner = nn.Linear(text + config.noise + WAVES, config.width)
        self.layers = nn.Sequential(inner, nn.SiLU(), nn.Linear(config.width, motion))

    def forward(self, sentence: Tensor, noise: Tensor, frames: int) -> Tensor:
        """Every frame alone, from the sentence, the noise and the time."""
        time = torch.arange(frames, device=sentence.device) * (2 * torch.pi)
        waves = torch.stack([torch.sin(time / 2**k) for k in range(1, WAVES + 1)], dim=-1)
        rows = torch.cat([sentence, noise], dim=-1)[:, None].expand(-1, frames, -1)
        motion: Tensor = self.layers(torch.cat([rows, waves.expand(len(rows), -1, -1)], dim=-1))
        return motion
