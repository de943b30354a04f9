"""Motions from a trained `MotionDiffuse`, by diffusers' samplers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.models.baselines.motiondiffuse.network import MotionDiffuse
from motionloom.models.diffusion.schedule import Sampler, by_length
from motionloom.models.gpt.frozen import evaluating


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
