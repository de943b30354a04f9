"""The Lightning side of TMA: sample latents, sum the weighted losses (HumanTOMATO appendix D.1)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from motionloom.models.layers import draws
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tma.losses import TmaLossConfig, info_nce, kl_four, latent_loss, reconstruction_loss
from motionloom.models.tma.network import Tma
from motionloom.models.training.stage_module import OptimConfig, StageModule


class TmaModule(StageModule):
    """Trains a `Tma` on the batches of `CaptionBatches`."""

    net: Tma

    def __init__(
        self,
        net: Tma,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        loss: TmaLossConfig | None = None,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.loss_config = loss or TmaLossConfig()

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "similarity" [B, S]
        (sBERT embeddings, for the filter), "present" bool [B, D] (optional: all).

        Columns of a part that a clip does not hold are 0, the mean, for the encoder and not reconstructed; it
        is judged in the coordinates that the encoder reads.
        Latents are sampled in training and are the means in evaluation. InfoNCE contrasts the means, as the
        published HumanTOMATO code does (TMR contrasts samples): retrieval uses the means too.
        """
        net, weight = self.net, self.loss_config
        motion, length = batch["motion"], batch["length"]
        words = batch["conditions"]["text"]
        text = net.encode_text(words.features, words.mask)
        present = batch.get("present")
        moved = net.encode_motion(motion, length, present)
        z_text, z_motion = self._latent(*text), self._latent(*moved)
        target, frames = net.strided(motion, length)
        target, mask = net.read(target, present), length_mask(frames, target.shape[1])
        size = motion.shape[1]
        rec_text = reconstruction_loss(net.write(z_text, length, size), target, mask, present)
        rec_motion = reconstruction_loss(net.write(z_motion, length, size), target, mask, present)
        kl = kl_four(text, moved)
        latent = latent_loss(z_text, z_motion)
        contrastive = info_nce(
            text[0],
            moved[0],
            batch["similarity"],
            temperature=weight.temperature,
            threshold=weight.threshold,
        )
        loss = (
            weight.reconstruction * (rec_text + rec_motion)
            + weight.kl * kl
            + weight.latent * latent
            + weight.contrastive * contrastive
        )
        return {
            "loss": loss,
            "rec_text": rec_text,
            "rec_motion": rec_motion,
            "kl": kl,
            "latent": latent,
            "contrastive": contrastive,
        }

    def _latent(self, mu: Tensor, logvar: Tensor) -> Tensor:
        if not self.training:
            return mu
        return mu + draws.normal_like(mu) * (0.5 * logvar).exp()
