"""Motion of text by a diffusion model of whole motions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.conditions import Conditions
from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.models.diffusion.schedule import Sampler, ScheduleConfig
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.edits.frames import EditFrames
from motionloom.pipeline.inference.generators.filling import fill_in
from motionloom.pipeline.inference.generators.whole import WholeMotion
from motionloom.pipeline.store.networks import device_of


class DenoisedMotion(WholeMotion):
    """Any model that denoises a whole motion."""

    who = "this diffusion model"
    method = "diffusion"
    settings = frozenset({"sampler", "denoising_steps"})

    @property
    @abstractmethod
    def schedule(self) -> ScheduleConfig:
        """The noise schedule of the training."""

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(denoising=self.denoising)

    def denoising(self, sampling: SamplingConfig) -> tuple[Sampler, int]:
        """As asked for, or else DDPM in 50 steps, or the training's where those are fewer."""
        return sampling.sampler or "ddpm", sampling.denoising_steps or min(50, self.schedule.steps)


@dataclass(frozen=True)
class DiffusionMotion(DenoisedMotion):
    """Denoising from a sentence embedding, of any part of the body (MDM; B.5.2)."""

    net: TextDenoiser
    window: int = 196
    """Frames that are edited at once: the longest motion of its training."""

    @property
    def schedule(self) -> ScheduleConfig:
        return self.net.config.schedule

    @property
    def settings(self) -> frozenset[str]:  # type: ignore[override]
        return super().settings | {"cfg_scale"} | ({"face_cfg_scale"} if self.part == "face" else set())

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        sampler, steps = self.denoising(request.sampling)
        sampling = request.sampling
        return sample_motions(
            self.net, request.pooled_text(self.who).to(device_of(self.net)), frames, seeds=request.seeds,
            sampler=sampler, steps=steps,
            guidance=self._guidance(sampling),
        )  # fmt: skip

    @property
    def capabilities(self) -> Capabilities:  # type: ignore[override]
        return Capabilities(denoising=self.denoising, edit=self.edit)

    def edit(
        self,
        frames: EditFrames,
        words: Sequence[tuple[Conditions, NDArray[np.float64]]],
        seeds: Sequence[int],
        sampling: SamplingConfig,
    ) -> list[NDArray[np.float32]]:
        """Fill in what an edit leaves free (`Editor`)."""
        sampler, steps = self.denoising(sampling)
        return fill_in(
            self.net, self.given["stats"], self.part, frames, words, seeds, window=self.window,
            sampler=sampler, steps=steps, guidance=self._guidance(sampling),
        )  # fmt: skip

    def _guidance(self, sampling: SamplingConfig) -> float:
        return sampling.face_guidance if self.part == "face" else sampling.cfg_scale
