"""Training of the denoisers: of motion given a caption (HumanTOMATO B.5.2), or its tokens (UDE section 3.4).

The DMD's motion is noised and denoised in the coordinates that the tokenizer reads (`Basis`), so that what
its gains make large, the path and the shapes of hands, is large here too [ours]. Without gains they are the
features.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.models.diffusion.dmd import Dmd, dmd_loss
from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.diffusion.observed import Showing
from motionloom.models.gpt.frozen import Frozen
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.models.training.distributed import mean_of_rows
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class DiffusionModule(StageModule):
    """Trains a `MotionDiffusion` on captioned `ConditionBatches`."""

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
        self.noiser = net.config.schedule.noiser()
        self.showing = showing

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "present" bool
        [B, D] (optional: all).

        Every clip counts alike, as in MDM. Time steps and noise are drawn in each call; in evaluation no
        caption is dropped.
        """
        motion, length, text = batch["motion"], batch["length"], batch["conditions"]["text"].pooled
        schedule = self.net.config.schedule
        mask = length_mask(length, motion.shape[1])
        step = torch.randint(0, schedule.steps, (len(motion),), device=motion.device)
        noise = torch.randn_like(motion)
        hidden = self.net.config.condition_dropout if self.training else 0.0
        conditioned = torch.rand(len(motion), device=motion.device) >= hidden
        noisy = self.noiser.add_noise(motion, noise, step)
        seen = None if self.showing is None else self.showing(motion, length)
        found = self.net(noisy, step, text, mask, conditioned, seen)
        target = motion if schedule.predicts == "sample" else noise
        error = found - target.to(found.dtype)
        loss = mean_of_rows(error.square(), mask, batch.get("present"))
        weight = self.net.config.velocity_weight
        if weight:
            between = error.diff(dim=1).square()
            loss = loss + weight * mean_of_rows(between, mask[:, 1:], batch.get("present"))
        return {"loss": loss}


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
