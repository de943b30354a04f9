"""Motion of text by MotionDiffuse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.models.diffusion.schedule import Sampler, ScheduleConfig, by_length
from motionloom.models.gpt.frozen import evaluating
from motionloom.pipeline.baselines.motiondiffuse.network import MotionDiffuse
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.inference.generators.diffusion import DenoisedMotion


@torch.no_grad()
def sample_motions(
    net: MotionDiffuse,
    text: Condition,
    frames: Sequence[int],
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddpm",
    steps: int = 50,
) -> list[Tensor]:
    """Normalised motions [T, D] for captions, one length and one seed each (`by_length`)."""
    with evaluating(net):
        read = net.read(text)

        def denoised(rows: list[int], x: Tensor, noise: list[torch.Generator]) -> Tensor:
            words = read.rows(rows)
            mask = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)

            def predict(given: Tensor, step: Tensor) -> Tensor:
                return net.denoise(given, step.to(x.device).expand(len(rows)), words, mask)

            return net.config.schedule.denoise(predict, x, noise, sampler, steps)

        return by_length(frames, seeds, net.motion_dim, text.features.device, denoised)


@dataclass(frozen=True)
class MotionDiffuseMotion(DenoisedMotion):
    """Denoising from the tokens of a caption, without guidance (MotionDiffuse)."""

    net: MotionDiffuse

    @property
    def schedule(self) -> ScheduleConfig:
        return self.net.config.schedule

    @property
    def max_frames(self) -> int:
        return self.net.max_frames

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        sampler, steps = self.denoising(request.sampling)
        return sample_motions(
            self.net, request.text(self.who), frames, seeds=request.seeds, sampler=sampler, steps=steps
        )
