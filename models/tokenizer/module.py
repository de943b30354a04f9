"""Training of a tokenizer (HumanTOMATO Algorithm 1); the codebooks learn by EMA, the rest by AdamW."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from motionloom.models.tokenizer.base import Tokenizer, TokenizerOutput
from motionloom.models.tokenizer.config import Recon
from motionloom.models.tokenizer.losses import tokenizer_loss
from motionloom.models.training.stage_module import OptimConfig, StageModule


class TokenizerModule(StageModule):
    """LightningModule around a `Tokenizer`; the loss arguments are `config.loss_terms()`."""

    net: Tokenizer

    def __init__(
        self,
        net: Tokenizer,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        alpha: float,
        recon: Recon,
        velocity_weight: float,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.alpha = alpha
        self.recon: Recon = recon
        self.velocity_weight = velocity_weight

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Losses of {"motion" [B, W, dim], "length" [B], "present" bool [B, dim] (optional: all)}.

        Entries: loss, recon, commit, velocity if it has a weight, and per stream `perplexity_<stream>`,
        `usage_`, `dead_`, `resets_`, `penalty_`.
        """
        motion, length, present = batch["motion"], batch["length"], batch.get("present")
        out: TokenizerOutput = self.net(motion, length, present)
        terms = tokenizer_loss(
            out.written,
            out.read,
            out.penalty,
            length,
            alpha=self.alpha,
            recon=self.recon,
            velocity_weight=self.velocity_weight,
            present=present,
        )
        return terms | out.metrics
