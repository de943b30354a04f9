"""Motion of text by one latent: TEMOS, and the facial cVAE (HumanTOMATO B.5.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.store.networks import LoadedTma


@dataclass(frozen=True)
class VaeMotion:
    """One latent of the text, decoded to all frames at once: TEMOS, and the facial cVAE (B.5.1)."""

    tma: LoadedTma
    method = "vae"
    modalities = frozenset({"text"})
    settings = frozenset({"temperature"})
    unit_frames = 1
    max_frames = None

    @property
    def layout(self) -> MotionLayout:
        return self.tma.layout

    @property
    def part(self) -> Part:
        return self.tma.part

    @property
    def prepared(self) -> Mapping[str, object]:
        return {"text": self.tma.given.get("text")}

    @torch.no_grad()
    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """The latent is drawn from the text's Gaussian; temperature scales its width. Of a network that
        writes every n-th frame, those between are on the straight line.
        """
        if request.frames is None:
            raise UserError(
                "this VAE makes a motion of a length that it is given, and none was; give --seconds, or to "
                "evaluate it lengths: recorded"
            )
        frames, seeds, device, net = request.frames, request.seeds, self.tma.device, self.tma.net
        text = request.text("this VAE")
        mu, logvar = net.encode_text(text.features.to(device), text.mask.to(device))
        noise = torch.stack(
            [torch.randn(mu.shape[1], generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        )
        z = mu + request.sampling.temperature * (0.5 * logvar).exp() * noise.to(device)
        made = net.decode(z, torch.tensor(list(frames)).to(device), max(frames))
        columns, stride = self.layout.part(self.part), net.config.frame_stride
        values = [between(made[row].cpu().numpy(), count, stride) for row, count in enumerate(frames)]
        return [np.asarray(self.tma.stats.denormalize(v, columns), dtype=np.float32) for v in values]


def between(values: NDArray[np.float32], frames: int, stride: int) -> NDArray[np.float32]:
    """Every `stride`-th frame [L, D] to `frames` frames [T, D]: linear between, constant after the last."""
    if stride == 1:
        return values[:frames]
    last = (frames - 1) // stride
    at = np.minimum(np.arange(frames) / stride, last)
    low = at.astype(int)
    high = np.minimum(low + 1, last)
    share = (at - low)[:, None].astype(values.dtype)
    out: NDArray[np.float32] = values[low] * (1 - share) + values[high] * share
    return out
