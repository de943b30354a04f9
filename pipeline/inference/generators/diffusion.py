"""Motion of text by a diffusion model of whole motions, and clips whose free parts it fills in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Conditions
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.canonical import runs
from motionloom.models.diffusion.editing import Filling, KnownMotion
from motionloom.models.diffusion.network import InBetweener, TextDenoiser
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
        able = isinstance(self.net, InBetweener)  # it observes what is known
        return Capabilities(denoising=self.denoising, edit=self.edit if able else None)

    def edit(
        self, frames: EditFrames, words: Conditions, seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """Fill in what an edit leaves free (`Capabilities.edit`): motions [T, C] of the part in their own
        units, one a seed; what is kept in them is so to the bit, and the rest near what is asked for.

        `words` are an encoded caption, one row; empty for none.
        """
        assert isinstance(self.net, InBetweener)
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
        # Without anything to go by, what is made further than that stands still and glides.
        most = self.window * 3 // 2
        empty = ~known.any(dim=1).numpy() & np.isnan(frames.path)
        if any(end - start > most for start, end in runs(empty)):
            raise UserError(
                f"this model knows motions of {self.window / layout.fps:g} s and fills at most "
                f"{most / layout.fps:g} s at a time: give fewer seconds, keep more or draw a path, and go on "
                f"from the result"
            )
        places = Places(*(values.to(device) for values in frames.places))
        text = words.get("text")
        pooled = None if text is None or text.pooled is None else text.pooled[0].float().to(device)
        normal = torch.from_numpy(stats.normalize(features.numpy(), columns))
        filling = Filling(
            self.net,
            KnownMotion(normal.to(device), known.to(device), places),
            pooled,
            Recovery(layout, columns, stats.mean, stats.std),
            window=self.window,
            overlap=self.window // 4,
            guidance=guidance,
        )
        made = filling(seeds, *self.denoising(sampling)).cpu()
        # What is kept is taken from where it came from: normalising there and back rounds.
        own = np.where(known, features, stats.denormalize(made.numpy(), columns))
        return [np.asarray(one, dtype=np.float32) for one in own]
