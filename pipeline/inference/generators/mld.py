"""Motion of text by diffusion of one latent (MLD)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionloom.models.baselines.mld.network import LatentDenoiser
from motionloom.models.baselines.mld.sampling import sample_latents
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.layers.transformer import length_mask
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.generators.whole import WholeMotion
from motionloom.pipeline.store.networks import LoadedMotionVae, device_of


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
        """Of the frames behind those of the training the decoder knows nothing."""
        return self.vae.max_frames

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
