"""Training of a tokenizer (HumanTOMATO Algorithm 1); the codebooks learn by EMA, the rest by AdamW."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from motionloom.models.tokenizer.base import Recon, Tokenizer, TokenizerOutput
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.stage_module import Batch, StageModule

_ERRORS = {"l1": functional.l1_loss, "l2": functional.mse_loss, "smooth_l1": functional.smooth_l1_loss}


def reconstruction_loss(
    recon: Tensor, target: Tensor, length: Tensor | None, kind: Recon, present: Tensor | None = None
) -> Tensor:
    """Mean error of [B, T, D] over the first `length` [B] frames of each clip and over the columns it holds.

    `kind`: "l1" absolute error; "l2" squared error; "smooth_l1" Huber with threshold 1. `present` bool
    [B, D]; None = all.
    """
    recon = recon.float()
    target = target.float()
    error = _ERRORS[kind](recon, target, reduction="none")
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


def tokenizer_losses(net: Tokenizer, batch: Batch) -> tuple[dict[str, Tensor], TokenizerOutput]:
    """Losses of {"motion" [B, W, dim], "length" [B], "present" bool [B, dim] (optional: all)}, and what they
    are of; what is weighed how is in the network's own config. A batch that is "full" needs no mask.

    Entries: loss = recon + commitment * commit + velocity_weight * velocity + position_weight * position;
    each of those with a weight, and per stream `perplexity_<stream>`, `usage_`, `dead_`, `resets_`,
    `penalty_`.
    """
    motion = batch["motion"]
    length = batch["length"]
    present = batch.get("present")
    if batch.get("full", False):
        length = present = None
    config = net.config
    out = net(motion, length, present)
    made = out.reconstruction
    target = out.input
    recon = reconstruction_loss(made, target, length, config.recon, present)
    terms = {"recon": recon, "commit": out.penalty}
    loss = recon + config.commitment() * out.penalty
    if config.velocity_weight > 0:
        terms["velocity"] = velocity_loss(made, target, length, config.recon, present)
        loss = loss + config.velocity_weight * terms["velocity"]
    if config.position_weight > 0:
        at = net.position_columns
        held = None if present is None else present[:, at]
        terms["position"] = reconstruction_loss(made[..., at], target[..., at], length, config.recon, held)
        loss = loss + config.position_weight * terms["position"]
    return {"loss": loss, **terms, **out.metrics}, out


class TokenizerModule(StageModule):
    """LightningModule around a `Tokenizer`."""

    net: Tokenizer

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return `tokenizer_losses` of "motion" [B, T, D], "length" [B], "present" bool [B, D] (or none)."""
        return tokenizer_losses(self.net, batch)[0]
