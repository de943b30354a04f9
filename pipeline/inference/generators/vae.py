"""Motion of text by one latent: TEMOS, and the facial cVAE (HumanTOMATO B.5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.inference.generators.base import WholeMotion
from motionloom.pipeline.store.networks import LoadedTma


@dataclass(frozen=True)
class VaeMotion(WholeMotion):
    """One latent of the text, decoded to all frames at once: TEMOS, and the facial cVAE (B.5.1)."""

    tma: LoadedTma
    who = "this VAE"
    method = "vae"
    settings = frozenset({"temperature"})

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[NDArray[np.float32]]:
        """The latent is drawn from the text's Gaussian; temperature scales its width. Of a network that
        writes every n-th frame, those between are on the straight line.
        """
        device, net = self.tma.device, self.tma.net
        text = request.text(self.who)
        mu, logvar = net.encode_text(text.features.to(device), text.mask.to(device))
        draws = [torch.Generator().manual_seed(seed) for seed in request.seeds]
        noise = torch.stack([torch.randn(mu.shape[1], generator=draw) for draw in draws])
        z = mu + request.sampling.temperature * (0.5 * logvar).exp() * noise.to(device)
        made = net.decode(z, torch.tensor(list(frames)).to(device), max(frames))
        stride = net.config.frame_stride
        return [between(made[row].cpu().numpy(), count, stride) for row, count in enumerate(frames)]


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
