"""Base of trainings with losses on joints in metres."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.training.stage_module import OptimConfig, StageModule


class JointsModule(StageModule):
    """Trains on normalised columns of bodies and hands.

    Args:
        layout: Layout whose body and hands are modelled.
        mean, std: Statistics of the columns of body and hands.
        loss: Weights of the losses.
    """

    loss_config: Config
    mean: Tensor
    std: Tensor

    def __init__(
        self,
        net: nn.Module,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        layout: MotionLayout,
        mean: NDArray[np.floating],
        std: NDArray[np.floating],
        loss: Config,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.layout = layout
        self.loss_config = loss
        for name, values in (("mean", mean), ("std", std)):
            self.register_buffer(name, torch.as_tensor(values), persistent=False)

    def in_units(self, motion: Tensor) -> Tensor:
        """Return normalised columns [B, T, D] in their own units."""
        return motion.float() * self.std + self.mean
