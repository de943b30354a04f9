"""Training of a tokenizer (HumanTOMATO Algorithm 1); the codebooks learn by EMA, the rest by AdamW."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from motionloom.models.tokenizer.base import Tokenizer, TokenizerOutput
from motionloom.models.tokenizer.config import Recon
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.stage_module import Batch, OptimConfig, StageModule


def reconstruction_loss(
    recon: Tensor, target: Tensor, length: Tensor | None, kind: Recon, present: Tensor | None = None
) -> Tensor:
    """Mean error of [B, T, D] over the first `length` [B] frames of each clip and over the columns it holds.

    `kind`: "l2" squared error; "smooth_l1" Huber with threshold 1. `present` bool [B, D]; None = all.
    """
    recon, target = recon.float(), target.float()
    if kind == "l2":
        error = functional.mse_loss(recon, target, reduction="none")
    else:
        error = functional.smooth_l1_loss(recon, target, reduction="none")
    if length is None and present is None:
        return error.mean()
    position = torch.arange(error.shape[1], device=error.device)
    end = position.new_full((len(error),), len(position)) if length is None else length
    return masked_mean(error, position < end[:, None], present)


def velocity_loss(
    recon: Tensor, target: Tensor, length: Tensor | None, kind: Recon, present: Tensor | None = None
) -> Tensor:
    """`reconstruction_loss` of frame-to-frame differences; between two valid frames only."""
    shorter = None if length is None else length - 1
    return reconstruction_loss(recon.float().diff(dim=1), target.float().diff(dim=1), shorter, kind, present)


def tokenizer_loss(
    recon_motion: Tensor,
    target: Tensor,
    penalty: Tensor,
    length: Tensor | None,
    *,
    alpha: float,
    recon: Recon,
    velocity_weight: float,
    present: Tensor | None = None,
) -> dict[str, Tensor]:
    """`loss` = recon + velocity_weight * velocity + alpha * penalty, and its terms `recon`, `commit` (and
    `velocity`).

    Args:
        recon_motion: [B, T, D] from the decoder.
        target: [B, T, D], normalised motion.
        length: [B] valid frames, or None.
        velocity_weight: Weight of the velocity term; 0 leaves it out.
        present: bool [B, D], false in columns that a clip does not hold: they do not count. None = all.
    """
    terms = {"recon": reconstruction_loss(recon_motion, target, length, recon, present), "commit": penalty}
    loss = terms["recon"] + alpha * penalty
    if velocity_weight > 0:
        terms["velocity"] = velocity_loss(recon_motion, target, length, recon, present)
        loss = loss + velocity_weight * terms["velocity"]
    return {"loss": loss, **terms}


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

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Losses of {"motion" [B, W, dim], "length" [B], "present" bool [B, dim] (optional: all)}.

        Entries: loss, recon, commit, velocity if it has a weight, and per stream `perplexity_<stream>`,
        `usage_`, `dead_`, `resets_`, `penalty_`.
        """
        motion, length, present = batch["motion"], batch["length"], batch.get("present")
        out: TokenizerOutput = self.net(motion, length, present)
        terms = tokenizer_loss(
            out.reconstruction,
            out.input,
            out.penalty,
            length,
            alpha=self.alpha,
            recon=self.recon,
            velocity_weight=self.velocity_weight,
            present=present,
        )
        return terms | out.metrics
