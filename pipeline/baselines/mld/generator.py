"""Motion of text by diffusion of one latent (MLD)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.schedule import Sampler, by_length
from motionloom.models.layers.transformer import length_mask
from motionloom.pipeline.baselines.mld.network import LatentDenoiser, LoadedMotionVae
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.generators.whole import WholeMotion
from motionloom.pipeline.store.networks import device_of


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


@dataclass(frozen=True)
class LatentMotion(WholeMotion):
    """A latent is denoised under a sentence embedding and decoded to all frames at once."""

    net: LatentDenoiser
    vae: LoadedMotionVae
    who = "this latent diffusion model"
    method = "mld"
    settings = frozenset({"cfg_scale", "sampler", "denoising_steps"})

    @property
    def max_frames(self) -> int | None:
        """Return the longest motion of the decoder's training."""
        return self.vae.max_frames

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(denoising=self.denoising)

    def denoising(self, sampling: SamplingConfig) -> tuple[Sampler, int]:
        """As asked for, or else DDIM in 50 steps, as published, or the training's where those are fewer."""
        steps = sampling.denoising_steps or min(50, self.net.config.schedule.steps)
        return sampling.sampler or "ddim", steps

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        sampler, steps = self.denoising(request.sampling)
        text = request.pooled_text(self.who).to(device_of(self.net))
        latents = sample_latents(
            self.net, text, seeds=request.seeds, sampler=sampler, steps=steps,
            guidance=request.sampling.cfg_scale,
        )  # fmt: skip
        mask = length_mask(torch.as_tensor(frames, device=latents.device), max(frames))
        return [made[:count] for made, count in zip(self.vae.net.decode(latents, mask), frames, strict=True)]
