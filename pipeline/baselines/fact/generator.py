"""Dances that go on from a motion, by FACT: frame after frame, each from those before it and the music."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.pipeline.baselines.fact.network import Fact
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.stages.networks.clips import music_of
from motionloom.pipeline.store.networks import device_of


@dataclass(frozen=True)
class FactGenerator:
    """One dance for each music; it draws nothing, so the motion that it begins with makes the difference."""

    net: Fact
    layout: MotionLayout
    part: Part
    given: Mapping[str, Any]
    """The stage's loaded inputs; "stats" and "audio" are read."""
    method = "fact"
    modalities = frozenset({"audio"})
    settings = frozenset[str]()
    unit_frames = 1
    max_frames = None
    decides_length = False

    @property
    def prepared(self) -> Mapping[str, object]:
        return {"audio": self.given.get("audio")}

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(seed_frames=self.net.config.motion_frames)

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Features in their own units; without seed motions each goes on from a kept one, by its seed."""
        lengths = request.lengths("FACT")
        columns, stats = self.layout.part(self.part), self.given["stats"]
        mean, std = stats.mean[columns], stats.std[columns]
        if request.seed_motions is None:
            begun = self.net.kept[[seed % len(self.net.kept) for seed in request.seeds]]
        else:
            begun = torch.from_numpy((np.stack(list(request.seed_motions)) - mean) / std)
        made = self.net.go_on(
            begun.to(device_of(self.net), torch.float32), music_of(request, self.given), max(lengths)
        )
        own = np.asarray(made.cpu().numpy() * std + mean, np.float32)
        return [motion[:count] for motion, count in zip(own, lengths, strict=True)]
