"""Motions from a trained denoiser, by diffusers' samplers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import torch
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.diffusion.schedule import Sampler


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
    """Normalised motions [T, D] for text vectors [n, E], one length and one seed each.

    Clips of one length are denoised together and each draws its noise from its own seed, so a motion does not
    depend on what it is generated with. `guidance` 1 is off; above it both passes go through one forward.
    `UserError` for guidance of a model that never trained without text, and for more `steps` than the
    training's.
    """
    if guidance != 1 and net.config.condition_dropout == 0:
        raise UserError(
            "guidance needs a diffusion model trained with condition_dropout > 0; set face_cfg_scale to 1"
        )
    net.eval()
    groups: dict[int, list[int]] = defaultdict(list)
    for row, count in enumerate(frames):
        groups[count].append(row)
    out: dict[int, Tensor] = {}
    for count, rows in groups.items():
        motion = _denoise(net, text[rows], count, [seeds[row] for row in rows], sampler, steps, guidance)
        out.update(zip(rows, motion, strict=True))
    return [out[row] for row in range(len(frames))]


def _denoise(
    net: MotionDiffusion,
    text: Tensor,
    frames: int,
    seeds: Sequence[int],
    sampler: Sampler,
    steps: int,
    guidance: float,
) -> Tensor:
    count, device = len(text), text.device
    noise = [torch.Generator().manual_seed(seed) for seed in seeds]
    x = torch.stack([torch.randn(frames, net.motion_dim, generator=g) for g in noise]).to(device)
    guided = guidance != 1.0
    conditioned = torch.ones(count * (1 + guided), dtype=torch.bool, device=device)
    conditioned[count:] = False
    text = text.repeat(1 + guided, 1)
    mask = torch.ones(len(conditioned), frames, dtype=torch.bool, device=device)

    def predict(given: Tensor, step: Tensor) -> Tensor:
        given, steps = given.repeat(1 + guided, 1, 1), step.to(device).expand(len(conditioned))
        found: Tensor = net(given, steps, text, mask, conditioned)
        return found[count:] + guidance * (found[:count] - found[count:]) if guided else found

    return net.config.schedule.denoise(predict, x, noise, sampler, steps)
