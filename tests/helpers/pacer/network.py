"""The network: music and noise to motion."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.motion.layout import Part
from motionloom.datasets.schema import Config

PART: Part = "bodyhand"


class PacerNetConfig(Config):
    """Sizes of the generator."""

    width: int = Field(32, ge=1)
    noise: int = Field(4, ge=1)
    """Width of the noise that tells two motions to one song apart."""


def convolutions(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """[B, inputs, T] -> [B, outputs, T]"""
    first, second = (nn.Conv1d(size, width, 9, padding=4) for size in (inputs, width))
    return nn.Sequential(first, nn.SiLU(), second, nn.SiLU(), nn.Conv1d(width, outputs, 1))


class Pacer(nn.Module):
    """Music [B, T, A] and noise [B, Z] to motion [B, T, D], both normalised."""

    def __init__(self, config: PacerNetConfig, audio: int, motion: int) -> None:
        super().__init__()
        self.audio, self.motion, self.noise = audio, motion, config.noise
        self.layers = convolutions(audio + config.noise, config.width, motion)

    def forward(self, audio: Tensor, noise: Tensor) -> Tensor:
        """The same noise in every frame."""
        made: Tensor = self.layers(torch.cat([audio, noise[:, None].expand(-1, audio.shape[1], -1)], -1).mT)
        return made.mT
