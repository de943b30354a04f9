"""Losses of the network and of its critic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from motionloom.models.training.alternating import AlternatingModule, OptimizerGroup
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from pacer.network import Pacer, PacerNetConfig, convolutions


class PacerConfig(TrainedStageConfig):
    """A recipe's `kind: pacer`. `optim` and `train` come with the base class."""

    net: PacerNetConfig = PacerNetConfig()
    critic: OptimConfig = OptimConfig(lr=2e-4)
    adversarial: float = Field(0.1, ge=0)
    """Weight of what the critic says."""
    window: int = Field(32, ge=8)
    """Frames of a training window; shorter clips are left out."""
    train: TrainConfig = TrainConfig(steps=1000, batch_size=16)


class PacerModule(AlternatingModule):
    """The generator follows the recording and the critic; the critic sets them apart."""

    net: Pacer

    def __init__(self, net: Pacer, config: PacerConfig, seed: int) -> None:
        super().__init__(net, config.optim, seed=seed, max_steps=config.train.steps)
        self.config = config
        self.critic = convolutions(net.motion + net.audio, config.net.width, 1)

    def optimizer_groups(self) -> Sequence[OptimizerGroup]:
        """In the order of their turns."""
        mine = OptimizerGroup("pacer", (self.net,), self.config.optim)
        return mine, OptimizerGroup("critic", (self.critic,), self.config.critic)

    def score(self, motion: Tensor, audio: Tensor) -> Tensor:
        """Of every frame; high for what looks recorded."""
        scores: Tensor = self.critic(torch.cat([motion, audio], -1).mT)
        return scores

    def losses_of(self, group: str, batch: dict[str, Any], shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Least squares, with the distance to the recording for the generator."""
        motion, audio = batch["motion"], batch["audio"]
        if group == "pacer":
            noise = torch.randn(len(motion), self.net.noise, device=motion.device)
            made = shared["made"] = self.net(audio, noise)
            distance = (made - motion).abs().mean()
            adversarial = (self.score(made, audio) - 1).square().mean()
            return {"loss": distance + self.config.adversarial * adversarial, "distance": distance}
        real, fake = self.score(motion, audio), self.score(shared["made"], audio)
        return {"loss": (real - 1).square().mean() + fake.square().mean(), "margin": (real - fake).mean()}
