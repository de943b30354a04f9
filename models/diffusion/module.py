"""Training of the denoiser: a random time step a sample, squared error over real frames (B.5.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class DiffusionModule(StageModule):
    """Trains a `MotionDiffusion` on captioned `ConditionBatches`."""

    net: MotionDiffusion

    def __init__(self, net: MotionDiffusion, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.noiser = net.config.schedule.noiser()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "present" bool
        [B, D] (optional: all).

        Time steps and noise are drawn in each call; in evaluation no caption is dropped.
        """
        motion, length, text = batch["motion"], batch["length"], batch["conditions"]["text"].pooled
        schedule = self.net.config.schedule
        mask = length_mask(length, motion.shape[1])
        step = torch.randint(0, schedule.steps, (len(motion),), device=motion.device)
        noise = torch.randn_like(motion)
        hidden = self.net.config.condition_dropout if self.training else 0.0
        conditioned = torch.rand(len(motion), device=motion.device) >= hidden
        noisy = self.noiser.add_noise(motion, noise, step)
        found = self.net(noisy, step, text, mask, conditioned)
        target = motion if schedule.predicts == "sample" else noise
        error = (found - target.float()).square()
        return {"loss": masked_mean(error, mask, batch.get("present"))}
