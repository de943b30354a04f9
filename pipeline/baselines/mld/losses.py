"""Losses of MLD's auto-encoder.

The published means run over padding too, where both sides are zero; these run over real frames alone
**[ours]**, so that what a motion costs does not depend on what it is batched with.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from motionloom.datasets.motion.features.torch_joints import present_joints, torch_joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Config
from motionloom.models.training.distributed import masked_mean


class MotionVaeLossConfig(Config):
    """Weights; the defaults are the published ones."""

    features: float = Field(default=1.0, ge=0)
    joints: float = Field(default=1.0, ge=0)
    kl: float = Field(default=1e-4, ge=0)


def smooth_l1_of_joints(
    pred: Tensor, target: Tensor, layout: MotionLayout, mask: Tensor, present: Tensor | None = None
) -> Tensor:
    """SmoothL1 of the joints in metres, mean over real frames and the joints that each clip holds.

    pred, target [B, T, D] in their own units; mask bool [B, T]; present bool [B, D] (None = all).
    """
    with torch.autocast(pred.device.type, enabled=False):
        found, wanted = (torch_joints_of(motion, layout) for motion in (pred.float(), target.float()))
        error = F.smooth_l1_loss(found, wanted, reduction="none").flatten(2)
        held = None if present is None else present_joints(present, layout).repeat_interleave(3, dim=1)
        return masked_mean(error, mask, held)
