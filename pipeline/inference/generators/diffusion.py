"""Motion of text by a diffusion model of whole motions, and clips whose free parts it fills in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.conditions import Conditions
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.editing import CaptionSpan, Filling, KnownMotion, Pins
from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.diffusion.observed import Places, Recovery, known_columns
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.edits.frames import EditFrames
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
    window: int = 196
    """Frames that are edited at once: the longest motion of its training."""

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
        """Fill in what an edit leaves free (`Capabilities.edit`): motions [T, C] of the part in their own
        units, one a seed; what is kept in them is so to the bit, and the rest near what is asked for.

        `words` are encoded, one row each and empty for no words, each with its share of every frame [T];
        those of all sum to 1 in each frame.
        """
        stats: FeatureStats = self.given["stats"]
        layout, columns, device = self.layout, self.layout.part(self.part), device_of(self.net)
        guidance = sampling.guidance_of(self.part)
        if guidance != 1 and self.net.config.condition_dropout == 0:
            raise UserError(
                "guidance needs a diffusion model trained with condition_dropout > 0; set cfg_scale to 1"
            )
        features = torch.from_numpy(frames.features[:, columns])
        known = known_columns(torch.from_numpy(frames.pieces)[None], layout, columns)[0]
        if known.all():
            return [features.numpy().copy() for _ in seeds]
        recovery = places = pins = None
        if Recovery.possible(layout, columns):
            recovery = Recovery(layout, columns, stats.mean, stats.std)
            places = Places(*(values.to(device) for values in frames.places))
            if frames.pins:
                at, joints = torch.tensor(list(frames.pins), device=device).T
                pins = Pins(at, joints, torch.tensor(frames.model_pins, device=device))
        filling = Filling(
            self.net,
            KnownMotion(stats.normalize(features, columns).to(device), known.to(device), places, pins),
            [self._caption_span(*pair) for pair in words],
            recovery,
            window=self.window,
            overlap=self.window // 4,
            guidance=guidance,
        )
        made = filling(seeds, *self.denoising(sampling)).cpu()
        # What is kept is taken from where it came from: normalising there and back rounds.
        own = torch.where(known, features, stats.denormalize(made, columns))
        return [np.asarray(one, dtype=np.float32) for one in own.numpy()]

    def _caption_span(self, conditions: Conditions, share: NDArray[np.float64]) -> CaptionSpan:
        """The sentence embedding of encoded words, zeros without any, and its share of every frame [T]."""
        text, device = conditions.get("text"), device_of(self.net)
        shares = torch.from_numpy(share).float().to(device)
        if text is None or text.pooled is None:
            return CaptionSpan(torch.zeros(self.net.text_dim, device=device), False, shares)
        return CaptionSpan(text.pooled[0].float().to(device), True, shares)
