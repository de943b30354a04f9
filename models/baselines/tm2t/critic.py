"""TM2T's tokenizer against a critic of its motion, as its release trains it (Guo et al. 2022, section 3.1).

    L = |motion - made| + penalty - weight E D(made), from `start` on
    L_D = (E max(0, 1 - D(motion)) + E max(0, 1 + D(made))) / 2

The critic is two strided convolutions with batch normalisation and one convolution to a score for every four
frames. Its means and variances are those of all ranks' rows, so that ranks equal one process.

Legend: B batch, T frames, D motion features, C channels.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim import Optimizer

from motionloom.models.baselines.tm2t.losses import CriticConfig
from motionloom.models.layers.strided import SLOPE
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tokenizer.module import tokenizer_losses
from motionloom.models.tokenizer.tm2t import Tm2tQuantizer
from motionloom.models.training.distributed import sum_over_ranks, sum_over_ranks_with_grad
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.players import Player, PlayersModule
from motionloom.models.training.stage_module import Batch, Execution


class RankNorm(nn.Module):
    """Batch normalisation of [B, C, T] over the rows of all ranks."""

    mean: Tensor
    var: Tensor

    def __init__(self, channels: int, momentum: float = 0.1) -> None:
        super().__init__()
        self.scale, self.shift = nn.Parameter(torch.ones(channels)), nn.Parameter(torch.zeros(channels))
        self.momentum = momentum
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        x = x.to(torch.promote_types(x.dtype, torch.float32))
        mean, var = self.mean.to(x), self.var.to(x)
        if self.training:
            count = sum_over_ranks(x.new_tensor(x.shape[0] * x.shape[2]))
            mean = sum_over_ranks_with_grad(x.sum((0, 2))) / count
            var = sum_over_ranks_with_grad((x - mean[:, None]).square().sum((0, 2))) / count
            with torch.no_grad():
                self.mean.lerp_(mean.to(self.mean), self.momentum)
                self.var.lerp_((var * count / (count - 1)).to(self.var), self.momentum)
        scaled = (x - mean[:, None]) * (var[:, None] + 1e-5).rsqrt()
        return scaled * self.scale[:, None] + self.shift[:, None]


class Critic(nn.Module):
    """Scores [B, T / 4] of motion [B, T, D], T a multiple of 4; higher is more real."""

    def __init__(self, motion_dim: int, width: int) -> None:
        super().__init__()
        widths = (motion_dim, width, width // 2)
        self.down = nn.ModuleList(nn.Conv1d(a, b, 4, stride=2, padding=1) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(map(RankNorm, widths[1:]))
        self.out = nn.Conv1d(width // 2, 1, 3, padding=1)

    def forward(self, motion: Tensor) -> Tensor:
        x = motion.transpose(1, 2)
        for down, norm in zip(self.down, self.norms, strict=True):
            x = functional.leaky_relu(norm(down(x)), SLOPE)
        scores: Tensor = self.out(x)[:, 0]
        return scores


class CriticisedModule(PlayersModule):
    """Trains TM2T's tokenizer, and the critic of what it makes. What a clip lacks is 0 in both."""

    net: Tm2tQuantizer

    def __init__(
        self, net: Tm2tQuantizer, optim: OptimConfig, *, seed: int, max_steps: int, critic: CriticConfig
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.critic_config = critic
        self.critic = Critic(net.dim, critic.width)
        self.judged = critic.start == 0
        """Whether the critic plays; no number, by which every step would be compiled anew."""

    def take_step(self, parts: Iterable[Batch], optimizers: list[Optimizer], how: Execution) -> Tensor:
        self.judged = self.step >= self.critic_config.start
        return super().take_step(parts, optimizers, how)

    def players(self) -> list[Player]:
        """The tokenizer, then the critic of what it has made."""
        start = self.critic_config.start
        return [
            Player("tokenizer", (self.net,), self.optim_config),
            Player("critic", (self.critic,), self.optim_config, start_step=start),
        ]

    def play(self, player: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """A player's loss of one batch, as `TokenizerModule` takes it."""
        if player == "critic":
            real, made = self.critic(shared["motion"]), self.critic(shared["made"])
            terms = {"real": functional.relu(1 - real).mean(), "made": functional.relu(1 + made).mean()}
            accuracy = ((real > 0).float().mean() + (made < 0).float().mean()) / 2
            return {"loss": (terms["real"] + terms["made"]) / 2, **terms, "accuracy": accuracy}
        values, out = tokenizer_losses(self.net, batch)
        there = length_mask(batch["length"], out.input.shape[1])[..., None]
        if "present" in batch:
            there = there & batch["present"][:, None]
        shared |= {"motion": out.input * there, "made": out.reconstruction * there}
        if self.training and not self.judged:
            return values
        values["adversarial"] = -self.critic(shared["made"]).mean()
        values["loss"] = values["loss"] + self.critic_config.weight * values["adversarial"]
        return values
