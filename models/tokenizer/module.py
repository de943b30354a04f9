"""Training of a tokenizer (HumanTOMATO Algorithm 1); the codebooks learn by EMA, the rest by AdamW."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from motionloom.models.stage_module import OptimConfig, StageModule
from motionloom.models.tokenizer.base import Tokenizer, TokenizerOutput
from motionloom.models.tokenizer.bones import Bones
from motionloom.models.tokenizer.config import Recon
from motionloom.models.tokenizer.losses import tokenizer_loss


class TokenizerModule(StageModule):
    """LightningModule around a `Tokenizer`; the loss arguments are `config.loss_terms()`.

    `std` are the statistics of all columns of the layout; only the bone term asks for them.
    """

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
        bone_weight: float = 0.0,
        std: NDArray[np.floating] | None = None,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.alpha = alpha
        self.recon: Recon = recon
        self.velocity_weight = velocity_weight
        self.bone_weight = bone_weight
        self.bones: Bones | None = None
        if bone_weight:
            if std is None:
                raise ValueError("bone_weight needs the statistics' standard deviations")
            self.bones = Bones(net.layout, net.layout.part(net.part), std)

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Losses of {"motion" [B, W, dim], "length" [B], "held" bool [B, dim] (optional: all)}.

        Entries: loss, recon, commit, velocity and bones if they have a weight, and per stream
        `perplexity_<stream>`, `usage_`, `dead_`, `resets_`, `penalty_`.
        """
        motion, length, held = batch["motion"], batch["length"], batch.get("held")
        out: TokenizerOutput = self.net(motion, length, held)
        terms = tokenizer_loss(
            out.recon,
            motion,
            out.penalty,
            length,
            alpha=self.alpha,
            recon=self.recon,
            velocity_weight=self.velocity_weight,
            bone_weight=self.bone_weight,
            bones=self.bones,
            held=held,
        )
        return terms | out.metrics
