"""The critic of a `CrossGpt`, and what it and the actor are trained by (Bailando, section 3.3)."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from motionloom.datasets.schema import Config
from motionloom.models.baselines.bailando.gpt import CrossGpt, CrossGptConfig, three_blocks
from motionloom.models.layers.transformer import Transformer


class RewardConfig(Config):
    """What dances are worth and who learns from it when; the defaults are the published ones."""

    critic_layers: int = Field(default=3, ge=1)
    scale: float = Field(default=10.0, gt=0)
    """A code with both beats is worth half of this, any other the negative half."""
    discount: float = Field(default=1.0, ge=0, le=1)
    actor_steps: int = Field(default=5, ge=1)
    critic_steps: int = Field(default=5, ge=1)
    """Steps of a turn."""
    temperature: float = Field(default=1.0, ge=0)
    """Of the codes that are danced in training; 0 takes the likeliest."""


class Critic(nn.Module):
    """Shared states [B, 3 L, D] -> what is still to come [B, L, 2], by half."""

    def __init__(self, config: CrossGptConfig, layers: int) -> None:
        super().__init__()
        self.stack = Transformer(config, layers)
        self.out = nn.ModuleList(nn.Linear(config.dim, 1, bias=False) for _ in range(2))

    def forward(self, states: Tensor, visible: Tensor) -> Tensor:
        """`visible` as of `tiled_causal`."""
        blocks = three_blocks(self.stack(states, visible))
        return torch.cat([out(blocks[:, k + 1]) for k, out in enumerate(self.out)], dim=-1)


class ActorCritic(nn.Module):
    """Both."""

    def __init__(self, gpt: CrossGpt, critic_layers: int) -> None:
        super().__init__()
        self.gpt = gpt
        self.critic = Critic(gpt.config, critic_layers)
