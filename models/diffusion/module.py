"""Training of the denoisers: of motion given a caption (HumanTOMATO B.5.2), or its tokens (UDE section 3.4).

The DMD's motion is noised and denoised in the coordinates that the tokenizer reads (`Basis`), so that what
its gains make large, the path and the shapes of hands, is large here too [ours]. Without gains they are the
features.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from motionloom.models.diffusion.dmd import Dmd
from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.layers.frozen import Frozen
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.models.training.distributed import masked_mean, mean_of_rows
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class DenoiserModule(StageModule):
    """Trains a denoiser of whole motions on captioned `ConditionBatches`."""

    net: Any

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.noiser = self.net.config.schedule.noiser()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "present"
        bool [B, D] (optional: all). Time steps and noise are drawn in each call.
        """
        batch = self.prepared(batch)
        motion = batch["motion"]
        schedule = self.net.config.schedule
        mask = length_mask(batch["length"], motion.shape[1])
        step = torch.randint(0, schedule.steps, (len(motion),), device=motion.device)
        noise = torch.randn_like(motion)
        predicted = self.predict(self.noiser.add_noise(motion, noise, step), step, batch, mask)
        target = motion if schedule.predicts == "sample" else noise
        return {"loss": self.mean(predicted - target.to(predicted.dtype), mask, batch.get("present"))}

    def prepared(self, batch: Batch) -> Batch:
        """Return the batch with what is noised as "motion" and its "length"."""
        return batch

    def predict(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        """Return the network's prediction [B, T, D] for noisy motions at step [B]; mask bool [B, T]."""
        predicted: Tensor = self.net(noisy, step, batch["conditions"]["text"], mask)
        return predicted

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        """Return the mean square of errors [B, T, D] where mask [B, T] and present [B, D] are set: every real
        frame counts alike.
        """
        return masked_mean(error.square(), mask, present)


class TextDenoiserModule(DenoiserModule):
    """Trains a `TextDenoiser` as MDM is: every clip counts alike; captions are dropped in training alone."""

    net: TextDenoiser

    def predict(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        predicted: Tensor = self.net(*self.conditions(noisy, step, batch, mask))
        return predicted

    def conditions(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> tuple[Tensor, ...]:
        """Return the arguments of a `TextDenoiser`, with texts hidden at random."""
        dropped = self.net.config.condition_dropout if self.training else 0.0
        conditioned = torch.rand(len(noisy), device=noisy.device) >= dropped
        return noisy, step, batch["conditions"]["text"].pooled, mask, conditioned

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        return mean_of_rows(error.square(), mask, present)


class DmdModule(DenoiserModule):
    """Trains a `Dmd` on windows of motion; the tokenizer that makes their tokens is frozen."""

    net: Dmd

    def __init__(
        self, net: Dmd, optim: OptimConfig, *, seed: int, max_steps: int, tokenizer: Tokenizer
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.tokenizer = Frozen(tokenizer)

    @torch.no_grad()
    def prepared(self, batch: Batch) -> Batch:
        """Return the batch with its motion in the tokenizer's coordinates, and their tokens as "codes"."""
        tokenizer = self.tokenizer.module
        motion = batch["motion"]
        present = batch.get("present")
        length = (batch["length"] // GROUP_FRAMES).clamp(min=1) * GROUP_FRAMES
        codes = tokenizer.encode(motion, length, present)
        return {**batch, "motion": tokenizer.coordinates(motion, present), "length": length, "codes": codes}

    def predict(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        length = batch["length"]
        size = -(-noisy.shape[1] // GROUP_FRAMES)
        hidden = hidden_stretch(length // GROUP_FRAMES, size, self.net.config.hide)
        predicted: Tensor = self.net(noisy, step, batch["codes"], length, hidden)
        return predicted

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        """Return the mean over the real frames of all ranks (equation 10), and by `velocity_weight` that of
        the error between frames.
        """
        loss = super().mean(error, mask, present)
        weight = self.net.config.velocity_weight
        # A difference of frames counts where both of them are real.
        if weight:
            loss = loss + weight * masked_mean(error.diff(dim=1).square(), mask[:, 1:], present)
        return loss


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
