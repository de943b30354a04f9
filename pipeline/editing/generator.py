"""Motion of text by an in-betweener, and clips whose free parts it fills in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Conditions
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.canonical import runs
from motionloom.pipeline.contract.generation import Capabilities
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.editing.frames import KnownFrames
from motionloom.pipeline.editing.inbetween.filling import Filling, KnownMotion
from motionloom.pipeline.editing.inbetween.network import InBetweener
from motionloom.pipeline.editing.inbetween.observed import Places, Recovery, known_columns
from motionloom.pipeline.inference.generators.diffusion import DiffusionMotion
from motionloom.pipeline.store.networks import device_of


@dataclass(frozen=True)
class InBetweenMotion(DiffusionMotion):
    """Also fills in clips: its network observes what is known."""

    net: InBetweener
    window: int = 196
    """Frames that are filled in at once: the longest motion of its training."""

    @property
    def capabilities(self) -> Capabilities:  # type: ignore[override]
        return replace(super().capabilities, more={"edit": self.edit})

    def edit(
        self, known: KnownFrames, words: Conditions, seeds: Sequence[int], sampling: SamplingConfig
    ) -> list[NDArray[np.float32]]:
        """Motions [T, C] of the part in their own units, one a seed, of an edit: what is kept in them is so
        to the bit, and what is left free is filled in near what is asked for.

        `words` are an encoded caption, one row; empty for none.
        """
        stats: FeatureStats = self.given["stats"]
        layout = self.layout
        columns = self.layout.part(self.part)
        device = device_of(self.net)
        guidance = sampling.guidance_of(self.part)
        if guidance != 1 and self.net.config.condition_dropout == 0:
            raise UserError(
                "guidance needs a diffusion model trained with condition_dropout > 0; set cfg_scale to 1"
            )
        features = torch.from_numpy(known.features[:, columns])
        given = known_columns(torch.from_numpy(known.pieces)[None], layout, columns)[0]
        if given.all():
            return [features.numpy().copy() for _ in seeds]
        # Without anything to go by, what is made further than that stands still and glides.
        most = self.window * 3 // 2
        empty = ~given.any(dim=1).numpy() & ~known.led
        if any(end - start > most for start, end in runs(empty)):
            raise UserError(
                f"this model knows motions of {self.window / layout.fps:g} s and fills at most "
                f"{most / layout.fps:g} s at a time: give fewer seconds, keep more or draw a path, and go on "
                f"from the result"
            )
        places = Places(*(values.to(device) for values in known.places))
        text = words.get("text")
        pooled = None if text is None or text.pooled is None else text.pooled[0].float().to(device)
        normal = torch.from_numpy(stats.normalize(features.numpy(), columns))
        filling = Filling(
            self.net,
            KnownMotion(normal.to(device), given.to(device), places),
            pooled,
            Recovery(layout, columns, stats.mean, stats.std),
            window=self.window,
            overlap=self.window // 4,
            guidance=guidance,
        )
        made = filling(seeds, *self.denoising(sampling)).cpu()
        # What is kept is taken from where it came from: normalising there and back rounds.
        own = np.where(given, features, stats.denormalize(made.numpy(), columns))
        return [np.asarray(one, dtype=np.float32) for one in own]
