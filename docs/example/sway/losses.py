"""The losses of our network, and one more for TMA."""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.models.layers.transformer import length_mask
from motionloom.models.tma.module import TmaModule
from motionloom.models.training.stage_module import Batch, StageModule
from sway.network import Sway


class SwayModule(StageModule):
    """Distance to the recording, in place and in speed."""

    net: Sway

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the losses of "motion" [B, T, D], "length" [B] and "conditions" with "text"."""
        motion, sentence = batch["motion"], batch["conditions"]["text"].pooled
        noise = torch.randn(len(motion), self.net.noise, device=motion.device)
        off = (self.net(sentence, noise, motion.shape[1]) - motion).abs()
        off = off * length_mask(batch["length"], motion.shape[1])[..., None]
        place, speed = off.mean(), off.diff(dim=1).abs().mean()
        return {"loss": place + 0.5 * speed, "place": place, "speed": speed}


class TightTmaModule(TmaModule):
    """TMA whose texts lie close together."""

    weight = 0.1

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """TMA's losses, with the squared length of the texts' latents."""
        text, found = batch["conditions"]["text"], super().losses(batch)
        tight = self.net.encode_text(text.features, text.mask)[0].square().mean()
        return {**found, "loss": found["loss"] + self.weight * tight, "tight": tight}
