"""Motion as long as its music."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from pacer.network import PART, Pacer


@dataclass(frozen=True)
class PacerGenerator:
    """Motion as long as its music."""

    net: Pacer
    layout: MotionLayout
    stats: FeatureStats
    audio: FrameStats
    part: Part = PART
    method = "pacer"
    modalities = frozenset({"audio"})
    settings: frozenset[str] = frozenset()
    unit_frames = 1
    max_frames = None
    decides_length = False
    capabilities = Capabilities()

    @property
    def prepared(self) -> dict[str, object]:
        """What the stage of its modality gives."""
        return {"audio": self.audio}

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Each row alone, so what it is batched with plays no part."""
        music = request.conditions.get("audio")
        if music is None or not bool(music.present.all()):
            raise UserError("the pacer is conditioned on music, and not every motion was given some")
        heard, device = music.mask.sum(1).tolist(), music.features.device
        out = []
        for row, (seed, frames) in enumerate(zip(request.seeds, request.frames or heard, strict=True)):
            # Music that ends before the motion does is present at its last frame.
            places = torch.arange(frames).clamp(max=heard[row] - 1)
            audio = self.audio.normalize(music.features[row].cpu().numpy()[places])
            noise = torch.randn(1, self.net.noise, generator=torch.Generator().manual_seed(seed))
            made = self.net(torch.from_numpy(audio)[None].to(device), noise.to(device))[0].cpu().numpy()
            out.append(np.asarray(self.stats.denormalize(made, self.layout.part(PART)), dtype=np.float32))
        return out
