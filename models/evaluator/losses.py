"""The evaluator's losses (Guo et al., CVPR 2022): its movement autoencoder's, and the margin loss of pairs.

Distributed: as in `models/tma/losses.py`, the mean over ranks of each value is that of the whole batch.
"""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from motionloom.datasets.base.config import Config
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.distributed import gather_rows_with_grad, masked_mean

MOVEMENT, MATCHING = "movement", "matching"
"""The groups, in the order in which they are trained."""


class EvaluatorLossConfig(Config):
    """Weights and margin; the defaults are the published ones."""

    margin: float = Field(default=10.0, gt=0)
    """Distance that latents of a caption and of another clip's motion are pushed apart to."""
    sparsity: float = Field(default=0.001, ge=0)
    """Weight of the mean size of a unit."""
    smoothness: float = Field(default=0.001, ge=0)
    """Weight of the change from a unit to the next."""


def movement_loss(
    pred: Tensor,
    target: Tensor,
    units: Tensor,
    count: Tensor,
    present: Tensor | None = None,
    *,
    config: EvaluatorLossConfig,
) -> dict[str, Tensor]:
    """`loss` of the autoencoder and its terms: L1 of the reconstruction, size and change of the units.

    Args:
        pred: [B, T, D].
        target: [B, T, D].
        units: [B, T / 4, C], what the encoder makes of `target`.
        count: Real units, int64 [B].
        present: bool [B, D]; None = all.
    """
    units = units.float()
    frames = length_mask(count * (pred.shape[1] // units.shape[1]), pred.shape[1])
    real = length_mask(count, units.shape[1])
    terms = {
        "reconstruction": masked_mean((pred.float() - target.float()).abs(), frames, present),
        "sparsity": masked_mean(units.abs(), real),
        "smoothness": masked_mean((units[:, 1:] - units[:, :-1]).abs(), real[:, 1:]),
    }
    weighted = config.sparsity * terms["sparsity"] + config.smoothness * terms["smoothness"]
    return {"loss": terms["reconstruction"] + weighted, **terms}


def matching_loss(text: Tensor, motion: Tensor, *, margin: float) -> dict[str, Tensor]:
    """`loss` of latents text, motion [B, Z]: squared distances of matching pairs, and of mismatching ones the
    square of what they lack to `margin`.

    Mismatching are all pairs of the global batch [ours]. The published code rolls the motions by one random
    number of rows a step; this is its mean over those rolls, without the draw. (Its draw may be no roll at
    all, which pushes matching pairs apart; that one is left out.)

    Beside them the mean distances: `own` of matching pairs, `other` of the rest.
    """
    with torch.autocast(text.device.type, enabled=False):
        text = gather_rows_with_grad(text.float())
        motion = gather_rows_with_grad(motion.float())
        distance = torch.cdist(text, motion, compute_mode="donot_use_mm_for_euclid_dist")
        other = ~torch.eye(len(text), dtype=torch.bool, device=text.device)
        # Squared before a root is drawn: its slope at 0 has no end.
        pulled = (text - motion).square().sum(-1).mean()
        pushed = torch.where(other, (margin - distance).clamp(min=0).square(), 0.0).sum()
        number = max(1, len(text) * (len(text) - 1))
        return {
            "loss": pulled + pushed / number,
            "own": distance.diagonal().mean(),
            "other": torch.where(other, distance, 0.0).sum() / number,
        }
