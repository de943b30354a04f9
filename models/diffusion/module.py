"""Training of the denoisers: of motion given a caption (HumanTOMATO B.5.2), or its tokens (UDE section 3.4).

The DMD's motion is noised and denoised in the coordinates that the tokenizer reads (`Basis`), so that what
its gains make large, the path and the shapes of hands, is large here too [ours]. Without gains they are the
features.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from motionloom.models.diffusion.dmd import Dmd, dmd_loss
from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.diffusion.observed import Showing
from motionloom.models.gpt.frozen import Frozen
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.models.training.distributed import masked_mean, mean_of_rows
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class DenoiserModule(StageModule):
    """Trains a denoiser of whole motions on captioned `ConditionBatches`; a kind of it says `predicted`."""

    net: Any

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.noiser = self.net.config.schedule.noiser()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "present" bool
        [B, D] (optional: all). Time steps and noise are drawn in each call.
        """
        motion, schedule = batch["motion"], self.net.config.schedule
        mask = length_mask(batch["length"], motion.shape[1])
        step = torch.randint(0, schedule.steps, (len(motion),), device=motion.device)
        noise = torch.randn_like(motion)
        found = self.predicted(self.noiser.add_noise(motion, noise, step), step, batch, mask)
        target = motion if schedule.predicts == "sample" else noise
        return {"loss": self.mean(found - target.to(found.dtype), mask, batch.get("present"))}

    @abstractmethod
    def predicted(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        """The network's answer [B, T, D] to noisy motions at step [B]; mask bool [B, T]."""

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        """Of squared errors [B, T, D] where mask [B, T] and present [B, D] say: every real frame alike."""
        return masked_mean(error.square(), mask, present)


class DiffusionModule(DenoiserModule):
    """Trains a `MotionDiffusion`. Every clip counts alike, as in MDM; in evaluation no caption is dropped."""

    net: MotionDiffusion

    def __init__(
        self,
        net: MotionDiffusion,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        showing: Showing | None = None,
    ) -> None:
        """`showing` is for networks with `observed` columns."""
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.showing = showing

    def predicted(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        hidden = self.net.config.condition_dropout if self.training else 0.0
        conditioned = torch.rand(len(noisy), device=noisy.device) >= hidden
        seen = None if self.showing is None else self.showing(batch["motion"], batch["length"])
        found: Tensor = self.net(noisy, step, batch["conditions"]["text"].pooled, mask, conditioned, seen)
        return found

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        loss = mean_of_rows(error.square(), mask, present)
        weight = self.net.config.velocity_weight
        if weight:
            loss = loss + weight * mean_of_rows(error.diff(dim=1).square(), mask[:, 1:], present)
        return loss


class DmdModule(StageModule):
    """Trains a `Dmd` on windows of motion; the tokenizer that makes their tokens is frozen."""

    net: Dmd

    def __init__(
        self, net: Dmd, optim: OptimConfig, *, seed: int, max_steps: int, tokenizer: Tokenizer
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.noiser = net.config.schedule.noiser()
        self.tokenizer = Frozen(tokenizer)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D] (the tokenizer's columns), "length" [B], "present" bool
        [B, D] (optional: all). Time steps and noise are drawn in each call.
        """
        motion, present = batch["motion"], batch.get("present")
        groups = (batch["length"] // GROUP_FRAMES).clamp(min=1)
        length = groups * GROUP_FRAMES
        with torch.no_grad():
            codes = self.tokenizer.module.encode(motion, length, present)
            seen = self.tokenizer.module.coordinates(motion, present)
        step = torch.randint(0, self.net.config.schedule.steps, (len(motion),), device=motion.device)
        noise = torch.randn_like(seen)
        hidden = hidden_stretch(groups, -(-motion.shape[1] // GROUP_FRAMES), self.net.config.hide)
        loss = dmd_loss(
            self.net, self.noiser, seen, codes, length, step, noise, hidden=hidden, present=present
        )
        return {"loss": loss}


def hidden_stretch(groups: Tensor, size: int, share: float) -> Tensor | None:
    """Bool [B, size]: in a `share` of the rows one stretch, of one group to half of the row's `groups` [B],
    is hidden; None where the share is 0.
    """
    if not share:
        return None
    chance, length, place = torch.rand(3, len(groups), device=groups.device).unbind()
    count = 1 + (length * (groups // 2)).long().clamp(max=(groups // 2 - 1).clamp(min=0))
    first = (place * (groups - count + 1)).long()
    at = torch.arange(size, device=groups.device)
    hidden: Tensor = (at >= first[:, None]) & (at < (first + count)[:, None]) & (chance < share)[:, None]
    return hidden
