"""The Lightning side of TMA: sample latents, sum the weighted losses (HumanTOMATO appendix D.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.models.layers.transformer import length_mask
from motionloom.models.tma.losses import TmaLossConfig, info_nce, kl_four, latent_loss, reconstruction_loss
from motionloom.models.tma.network import Tma
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


class TmaModule(StageModule):
    """Trains a `Tma` on captioned `ConditionBatches`."""

    net: Tma

    def __init__(
        self, net: Tma, optim: OptimConfig, *, seed: int, max_steps: int, loss: TmaLossConfig | None = None
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.loss_config = loss or TmaLossConfig()

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "similarity" [B, S]
        (sBERT embeddings, for the filter), "present" bool [B, D] (optional: all).

        Columns of a part that a clip does not hold are 0, the mean, for the encoder and not reconstructed; it
        is judged in the coordinates that the encoder reads.
        Latents are sampled in training and are the means in evaluation. InfoNCE contrasts the means, as the
        published HumanTOMATO code does (TMR contrasts samples): retrieval uses the means too.
        """
        net = self.net
        config = self.loss_config
        motion = batch["motion"]
        length = batch["length"]
        present = batch.get("present")
        text_features = batch["conditions"]["text"]
        text = net.encode_text(text_features.features, text_features.mask)
        encoded_motion = net.encode_motion(motion, length, present)
        z_text = self._sample(*text)
        z_motion = self._sample(*encoded_motion)

        # Both latents are decoded and compared with the motion that the encoder saw.
        subsampled, frames = net.subsample(motion, length)
        target = net.coordinates(subsampled, present)
        mask = length_mask(frames, subsampled.shape[1])
        both = net.decode_coordinates(torch.cat([z_text, z_motion]), length.repeat(2), motion.shape[1])
        from_text, from_motion = both.chunk(2)
        losses = {
            "rec_text": reconstruction_loss(from_text, target, mask, present),
            "rec_motion": reconstruction_loss(from_motion, target, mask, present),
            "kl": kl_four(text, encoded_motion),
            "latent": latent_loss(z_text, z_motion),
            # The means are contrasted, which are what retrieval uses.
            "contrastive": info_nce(
                text[0],
                encoded_motion[0],
                batch["similarity"],
                temperature=config.temperature,
                threshold=config.threshold,
            ),
        }
        loss = (
            config.reconstruction * (losses["rec_text"] + losses["rec_motion"])
            + config.kl * losses["kl"]
            + config.latent * losses["latent"]
            + config.contrastive * losses["contrastive"]
        )
        return {"loss": loss, **losses}

    def _sample(self, mu: Tensor, logvar: Tensor) -> Tensor:
        if not self.training:
            return mu
        return mu + torch.randn_like(mu) * (0.5 * logvar).exp()
