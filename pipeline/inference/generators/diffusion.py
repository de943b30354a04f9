"""Expressions by a motion diffusion model: the second facial baseline (HumanTOMATO B.5.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.store.networks import device_of


@dataclass(frozen=True)
class DiffusionFace:
    """Denoising from a sentence embedding (B.5.2)."""

    net: MotionDiffusion
    layout: MotionLayout
    given: Mapping[str, Any]
    method = "diffusion"
    modalities = frozenset({"text"})
    settings = frozenset({"cfg_scale", "face_cfg_scale", "sampler", "denoising_steps"})
    unit_frames = 1
    max_frames = None
    part: Part = "face"

    @property
    def prepared(self) -> Mapping[str, object]:
        return {"text": self.given.get("text")}

    def denoising(self, sampling: SamplingConfig) -> tuple[Sampler, int]:
        """As asked for, or else DDPM in 50 steps."""
        return sampling.sampler or "ddpm", sampling.denoising_steps or 50

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        if request.frames is None:
            raise UserError("the face's diffusion model makes a length that it is given, and none was")
        sampler, steps = self.denoising(request.sampling)
        made = sample_motions(
            self.net, request.pooled_text("the face's diffusion model").to(device_of(self.net)),
            request.frames, seeds=request.seeds, sampler=sampler, steps=steps,
            guidance=request.sampling.face_guidance,
        )  # fmt: skip
        columns = self.layout.part(self.part)
        values = [motion.cpu().numpy() for motion in made]
        return [np.asarray(self.given["stats"].denormalize(v, columns), dtype=np.float32) for v in values]
