"""The Lightning side of MotionCLIP.

Joints stand in for the vertices of the published loss **[ours]**: they need no body model. Its second cosine,
to CLIP's view of a rendered frame, is left out **[ours]**: an image needs a rendered body and an encoder of
images that shares the text stage's space, and neither comes with this project.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from motionloom.datasets.motion.features.torch_joints import present_joints, torch_joints_of
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.joints_module import JointsModule
from motionloom.models.training.stage_module import Batch
from motionloom.pipeline.baselines.motionclip.network import MotionClip, MotionClipLossConfig


class MotionClipModule(JointsModule):
    """Trains a `MotionClip` on captioned `ConditionBatches`."""

    net: MotionClip
    loss_config: MotionClipLossConfig

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Loss of one batch: "motion" [B, T, D], "length" [B], "conditions" with "text", "present" bool
        [B, D] (optional: all). Means of squared errors over real frames, and of 1 - cosine over clips.
        """
        net = self.net
        config = self.loss_config
        present = batch.get("present")
        motion = net.coordinates(batch["motion"], present)
        mask = length_mask(batch["length"], motion.shape[1])
        z = net.encode(motion, mask)
        # Padding of the decoder's output is zero, and that of the motion may not be.
        error = (net.decode(z, mask) - motion.float()) * mask[..., None]
        columns = None if net.sixd is not None else present
        held = None if present is None else present_joints(present, self.layout).repeat_interleave(3, dim=1)
        apart = self._joints(motion.float() + error) - self._joints(motion.float())
        text = batch["conditions"]["text"].pooled
        losses = {
            "features": masked_mean(error.square(), mask, columns),
            "joints": masked_mean(apart.flatten(2).square(), mask, held),
            "velocities": masked_mean(error.diff(dim=1).square(), mask[:, 1:], columns),
            "text": (1 - F.cosine_similarity(z, text.float(), dim=-1)).mean(),
        }
        loss = torch.stack([getattr(config, name) * value for name, value in losses.items()]).sum()
        return {"loss": loss, **losses}

    def _joints(self, motion: Tensor) -> Tensor:
        """Joints [B, T, N, 3] in metres of coordinates [B, T, D]."""
        with torch.autocast(motion.device.type, enabled=False):
            if self.net.sixd is not None:
                return self.net.sixd.joints(motion)
            return torch_joints_of(self.in_units(motion), self.layout)
