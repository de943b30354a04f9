"""Settings of an optimizer: learning-rate schedule, weight decay and gradient clipping."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from motionloom.datasets.base.config import Config

Beta = Annotated[float, Field(ge=0, lt=1)]
"""Share of a moving average that each step keeps."""


class OptimConfig(Config):
    """Adam or AdamW and its learning-rate schedule."""

    optimizer: Literal["adamw", "adam"] = "adamw"
    """`adam` adds the weight decay to the gradient (L2), `adamw` takes it from the weights."""
    lr: float = Field(1e-4, gt=0)
    betas: tuple[Beta, Beta] = (0.9, 0.99)
    weight_decay: float = Field(0.0, ge=0)
    warmup_steps: int = Field(0, ge=0)
    schedule: Literal["constant", "cosine"] = "constant"
    drop_at: tuple[int, ...] = ()
    """Steps from which on the rate is `drop_factor` times what it was."""
    drop_factor: float = Field(0.1, gt=0, lt=1)
    grad_clip: float = Field(1.0, ge=0)
    """Largest gradient norm; 0 turns clipping off."""

    def build(self, params: Sequence[nn.Parameter]) -> Optimizer:
        """Return a fused optimizer of these parameters."""
        kind = torch.optim.AdamW if self.optimizer == "adamw" else torch.optim.Adam
        return kind(params, lr=self.lr, betas=self.betas, weight_decay=self.weight_decay, fused=True)

    def factor(self, step: int, max_steps: int) -> float:
        """Return the factor of `lr` in step `step` of `max_steps`: warm-up, then schedule and drops."""
        dropped = self.drop_factor ** sum(step >= at for at in self.drop_at)
        return dropped * self._scheduled(step, max_steps)

    def doubts(self, max_steps: int) -> list[str]:
        """Return keys that will hardly do what is meant in a training of `max_steps`, and why."""
        if self.warmup_steps <= max_steps:
            return []
        reached = self.lr * max_steps / self.warmup_steps
        return [
            f"warmup_steps {self.warmup_steps:,} is longer than the training, {max_steps:,} steps: its rate "
            f"ends at {reached:.2g} of {self.lr:.2g}"
        ]

    def _scheduled(self, step: int, max_steps: int) -> float:
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        if self.schedule == "constant":
            return 1.0
        done = (step - self.warmup_steps) / max(1, max_steps - self.warmup_steps)
        return 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


class StepSchedule(LambdaLR):
    """Learning-rate schedule that depends on the step alone, as a factor of `lr`."""

    def set_step(self, step: int) -> float:
        """Set and return the learning rate of a step, whichever step came before."""
        self.last_epoch, factor = step, self.lr_lambdas[0](step)
        for group, first in zip(self.optimizer.param_groups, self.base_lrs, strict=True):
            group["lr"] = first * factor
        self._last_lr = [group["lr"] for group in self.optimizer.param_groups]
        return float(self._last_lr[0])

    def state_dict(self) -> dict[str, Any]:
        """Return the step, which is all that a rate depends on."""
        return {"last_epoch": self.last_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing: a training sets the step that it goes on from."""
