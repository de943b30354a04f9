"""Latents of motion from a trained MLD, denoised under a text."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.baselines.mld.network import LatentDenoiser
from motionloom.models.diffusion.schedule import Sampler, by_length


@torch.no_grad()
def sample_latents(
    net: LatentDenoiser,
    text: Tensor,
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddim",
    steps: int = 50,
    guidance: float = 7.5,
) -> Tensor:
    """Latents [n, K, C] for text vectors [n, E], one seed each.

    `guidance` 1 is off. `UserError` for guidance of a network that never trained without text, and for more
    `steps` than the training's.
    """
    if guidance != 1 and net.config.condition_dropout == 0:
        raise UserError(
            "guidance needs a latent diffusion trained with condition_dropout > 0; set cfg_scale to 1"
        )
    net.eval()
    guided, count = guidance != 1.0, len(text)
    both = text.repeat(1 + guided, 1)
    conditioned = torch.arange(len(both), device=text.device) < count

    def denoised(rows: list[int], x: Tensor, noise: list[torch.Generator]) -> Tensor:
        def predict(given: Tensor, step: Tensor) -> Tensor:
            steps = step.to(text.device).expand(len(both))
            found: Tensor = net(given.repeat(1 + guided, 1, 1), steps, both, conditioned)
            return found[count:] + guidance * (found[:count] - found[count:]) if guided else found

        return net.config.schedule.denoise(predict, x, noise, sampler, steps)

    latents = by_length([net.latent_tokens] * count, seeds, net.config.dim, text.device, denoised)
    return torch.stack(latents)
