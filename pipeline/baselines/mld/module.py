"""The Lightning sides of MLD: first its auto-encoder, then the denoiser of the frozen one's latents."""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.models.diffusion.module import DenoiserModule
from motionloom.models.layers.frozen import Frozen
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tma.losses import kl_divergence, reconstruction_loss
from motionloom.models.training.joints_module import JointsModule
from motionloom.models.training.stage_module import Batch, OptimConfig
from motionloom.pipeline.baselines.mld.network import (
    LatentDenoiser,
    MotionVae,
    MotionVaeLossConfig,
    mask_missing,
    smooth_l1_of_joints,
)


class MotionVaeModule(JointsModule):
    """Trains a `MotionVae` on whole clips."""

    net: MotionVae
    loss_config: MotionVaeLossConfig

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of "motion" [B, T, D], "length" [B], optional "present"; latents are means in evaluation."""
        motion = batch["motion"]
        present = batch.get("present")
        config = self.loss_config
        mask = length_mask(batch["length"], motion.shape[1])
        mu, logvar = self.net.encode(mask_missing(motion, present), mask)
        rebuilt = self.net.decode(drawn(mu, logvar) if self.training else mu, mask)
        found, wanted = map(self.in_units, (rebuilt, motion))
        zero = torch.zeros_like(mu)
        losses = {
            "features": reconstruction_loss(rebuilt, motion, mask, present),
            "joints": smooth_l1_of_joints(found, wanted, self.layout, mask, present),
            "kl": kl_divergence(mu, logvar, zero, zero),
        }
        loss = sum(getattr(config, name) * value for name, value in losses.items())
        assert isinstance(loss, Tensor)
        return {"loss": loss, **losses}


class LatentDiffusionModule(DenoiserModule):
    """Trains a `LatentDenoiser` on captioned `ConditionBatches`; the auto-encoder is frozen, dropout off."""

    net: LatentDenoiser

    def __init__(
        self, net: LatentDenoiser, optim: OptimConfig, *, seed: int, max_steps: int, vae: MotionVae
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.vae = Frozen(vae)

    @torch.no_grad()
    def prepared(self, batch: Batch) -> Batch:
        """Return the latents of motions as "motion" [B, K, C]: drawn in training, else their means."""
        motion = batch["motion"]
        mask = length_mask(batch["length"], motion.shape[1])
        mu, logvar = self.vae.module.encode(mask_missing(motion, batch.get("present")), mask)
        z = drawn(mu, logvar) if self.training else mu
        return {**batch, "motion": z, "length": torch.full((len(z),), z.shape[1], device=z.device)}

    def predict(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        hidden = self.net.config.condition_dropout if self.training else 0.0
        conditioned = torch.rand(len(noisy), device=noisy.device) >= hidden
        predicted: Tensor = self.net(noisy, step, batch["conditions"]["text"].pooled, conditioned)
        return predicted

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        return error.square().mean()


def drawn(mu: Tensor, logvar: Tensor) -> Tensor:
    """A sample of the Gaussians."""
    return mu + torch.randn_like(mu) * (0.5 * logvar).exp()
