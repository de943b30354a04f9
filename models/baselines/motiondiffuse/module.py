"""Training of MotionDiffuse: every real frame's error counts alike, and no caption is hidden."""

from __future__ import annotations

from torch import Tensor

from motionloom.models.baselines.motiondiffuse.network import MotionDiffuse
from motionloom.models.diffusion.module import DenoiserModule
from motionloom.models.training.stage_module import Batch


class MotionDiffuseModule(DenoiserModule):
    """Trains a `MotionDiffuse` on captioned `ConditionBatches`."""

    net: MotionDiffuse

    def predicted(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        found: Tensor = self.net(noisy, step, batch["conditions"]["text"], mask)
        return found
