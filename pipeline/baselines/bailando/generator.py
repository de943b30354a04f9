"""Dances of two halves' codes that follow music (Bailando), as features of the layout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.smpl75 import fit_smpl75
from motionloom.datasets.motion.layout import Part
from motionloom.pipeline.baselines.bailando.codes import DanceVq
from motionloom.pipeline.baselines.bailando.dances import joints_of_dance
from motionloom.pipeline.baselines.bailando.network import CrossGpt
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest
from motionloom.pipeline.inference.generators.base import DanceGenerator
from motionloom.pipeline.store.networks import device_of


@dataclass(frozen=True)
class BailandoGenerator(DanceGenerator):
    """Dances by the likeliest codes."""

    gpt: CrossGpt
    vq: DanceVq
    note: str = ""
    """A remark that its figures must carry."""
    method = "bailando"
    part: Part = "bodyhand"

    @property
    def unit_frames(self) -> int:
        return self.vq.config.code_frames

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(seed_frames=self.unit_frames, note=self.note)

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Dances that begin with the seed motions' codes, or with a kept code by their seed."""
        lengths = request.lengths("Bailando")
        count = max(lengths) // self.unit_frames
        device = device_of(self.gpt)
        gpt = self.gpt
        if request.seed_motions is None:
            first = gpt.kept[[seed % len(gpt.kept) for seed in request.seeds]][:, None]
        else:
            seeds = np.stack([joints_of_dance(motion, self.layout) for motion in request.seed_motions])
            first = self.vq.encode(torch.from_numpy(seeds).to(device, torch.float32))
        music = gpt.heard(self.music(request), self.unit_frames, count)
        codes = gpt.dance(first, music.to(device))
        out = []
        for row, frames in zip(codes, lengths, strict=True):
            joints = self.vq.decode(row[None, : frames // self.unit_frames])[0].double().cpu().numpy()
            if self.layout.name == "smpl75":
                made = fit_smpl75(joints)
            else:
                made = encode(canonicalize(joints), self.layout.without_face())
            # One family has a frame less than its joints.
            out.append(np.concatenate([made, made[-1:]])[:frames])
        return out
