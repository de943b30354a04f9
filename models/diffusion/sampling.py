"""Motions from a trained denoiser, by diffusers' samplers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.diffusion.schedule import Sampler, by_length


@torch.no_grad()
def sample_motions(
    net: MotionDiffusion,
    text: Tensor,
    frames: Sequence[int],
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddpm",
    steps: int = 50,
    guidance: float = 1.0,
) -> list[Tensor]:
    """Normalised motions [T, D] for text vectors [n, E], one length and one seed each (`by_length`).

    `guidance` 1 is off; above it both passes go through one forward. `UserError` for guidance of a model that
    never trained without text, and for more `steps` than the training's.
    """
    if guidance != 1 and net.config.condition_dropout == 0:
        raise UserError(
            "guidance needs a diffusion model trained with condition_dropout > 0; set face_cfg_scale to 1"
        )
    net.eval()
    guided = guidance != 1.0

    def denoised(rows: list[int], x: Tensor, noise: list[torch.Generator]) -> Tensor:
        count = len(rows)
        both = text[rows].repeat(1 + guided, 1)
        conditioned = torch.arange(len(both), device=text.device) < count
        mask = torch.ones(len(both), x.shape[1], dtype=torch.bool, device=text.device)

        def predict(given: Tensor, step: Tensor) -> Tensor:
            given, steps = given.repeat(1 + guided, 1, 1), step.to(text.device).expand(len(both))
            found: Tensor = net(given, steps, both, mask, conditioned)
            return found[count:] + guidance * (found[:count] - found[count:]) if guided else found

        return net.config.schedule.denoise(predict, x, noise, sampler, steps)

    return by_length(frames, seeds, net.motion_dim, text.device, denoised)
