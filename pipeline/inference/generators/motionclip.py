"""Motion of text by MotionCLIP: the sentence embedding is the latent, and it is decoded as it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionloom.models.baselines.motionclip.network import MotionClip
from motionloom.models.layers.transformer import length_mask
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.inference.generators.whole import WholeMotion
from motionloom.pipeline.store.networks import device_of


@dataclass(frozen=True)
class TextAsLatent(WholeMotion):
    """One motion a text: nothing is drawn."""

    net: MotionClip
    trained_frames: int
    who = "this MotionCLIP"
    method = "motionclip"

    @property
    def max_frames(self) -> int | None:
        """No longer motion was in the training, and what the decoder makes of it stands still."""
        return self.trained_frames

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        text = request.pooled_text(self.who).to(device_of(self.net))
        mask = length_mask(torch.as_tensor(frames, device=text.device), max(frames))
        made = self.net.decode(text, mask)
        return [self.net.features(row[:count]) for row, count in zip(made, frames, strict=True)]
