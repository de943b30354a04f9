"""Motion of text by a diffusion model of whole motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.generators.base import WholeMotion
from motionloom.pipeline.store.networks import device_of


class DenoisedMotion(WholeMotion):
    """Any model that denoises a whole motion."""

    net: Any
    """Its `config` has the noise `schedule` of the training."""
    usual: ClassVar[Sampler] = "ddpm"
    """Sampler where nobody asks for one, in 50 steps or the training's where those are fewer."""
    who = "this diffusion model"
    method = "diffusion"
    settings = frozenset({"sampler", "denoising_steps"})

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(denoising=self.denoising)

    def denoising(self, sampling: SamplingConfig) -> tuple[Sampler, int]:
        """As asked for, or else as `usual`."""
        steps = sampling.denoising_steps or min(50, self.net.config.schedule.steps)
        return sampling.sampler or self.usual, steps


@dataclass(frozen=True)
class DiffusionMotion(DenoisedMotion):
    """Denoising from a sentence embedding, of any part of the body (MDM; B.5.2)."""

    net: TextDenoiser

    @property
    def settings(self) -> frozenset[str]:  # type: ignore[override]
        return super().settings | {"cfg_scale"} | ({"face_cfg_scale"} if self.part == "face" else set())

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        sampler, steps = self.denoising(request.sampling)
        sampling = request.sampling
        return sample_motions(
            self.net, request.pooled_text(self.who).to(device_of(self.net)), frames, seeds=request.seeds,
            sampler=sampler, steps=steps,
            guidance=sampling.guidance_of(self.part),
        )  # fmt: skip
