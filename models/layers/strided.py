"""Plain strided 1-D convolutions between frames and a quarter of their rate (UDE sections 3.1 and 3.3).

UDE names "three-layer temporal 1D convolution networks": down are two stride-2 layers and one that keeps the
rate, up is the mirror. Each stride-2 layer is followed by `depth` residual blocks (one in public UDE code,
none is the bare text). Borders, padding and the residual blocks are those of `layers/conv.py`: a clip in a
padded batch gives what it gives alone. Activations are leaky ReLU with slope 0.2, as public.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.models.layers.conv import Conv, ResidualStack, real_frames, start_weights, zero_padded

SLOPE = 0.2
"""Slope of the leaky ReLU below zero."""


def _active(x: Tensor) -> Tensor:
    return functional.leaky_relu(x, SLOPE)


class StridedEncoder(nn.Module):
    """Frames to latents, [B, T, dim] -> [B, T / 4, out_dim]."""

    def __init__(self, dim: int, out_dim: int, *, width: int, depth: int, dilation_growth: int = 1) -> None:
        super().__init__()
        widths = [dim, width, width]
        self.down = nn.ModuleList(Conv(a, b, 4, stride=2, padding=1) for a, b in pairwise(widths))
        self.stacks = nn.ModuleList(ResidualStack(width, depth, dilation_growth) for _ in range(2))
        self.out = Conv(width, out_dim, 3, padding=1)
        start_weights(self, SLOPE)

    def forward(self, x: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = frames that are not padding; T and `valid` are multiples of 4."""
        real = [real_frames(valid, x.shape[1], 2**i) for i in range(3)]
        hidden = x
        for i, (down, stack) in enumerate(zip(self.down, self.stacks, strict=True)):
            hidden = stack(_active(down(zero_padded(hidden, real[i]))), real[i + 1])
        latents: Tensor = self.out(zero_padded(hidden, real[2]))
        return latents


class StridedDecoder(nn.Module):
    """Latents to frames, [B, L, dim] -> [B, 4 L, out_dim]; up-sampling repeats the nearest."""

    def __init__(self, dim: int, out_dim: int, *, width: int, depth: int, dilation_growth: int = 1) -> None:
        super().__init__()
        widths = [dim, width, width]
        self.up = nn.ModuleList(Conv(a, b, 3, padding=1) for a, b in pairwise(widths))
        self.stacks = nn.ModuleList(ResidualStack(width, depth, dilation_growth) for _ in range(2))
        self.out = Conv(width, out_dim, 3, padding=1)
        start_weights(self, SLOPE)
        with torch.no_grad():
            self.out.weight.mul_(0.1)  # near the mean pose, which is zero

    def forward(self, z: Tensor, valid: Tensor | None = None) -> Tensor:
        """`valid` [B] = *frames* that are not padding, a multiple of 4; padded frames come out as zero."""
        real = [real_frames(valid, z.shape[1] * 4, 2**i) for i in range(3)]
        hidden = z
        for i, (up, stack) in enumerate(zip(self.up, self.stacks, strict=True)):
            level = 1 - i
            wide = zero_padded(hidden, real[level + 1]).repeat_interleave(2, dim=1)
            hidden = stack(_active(up(wide)), real[level])
        return zero_padded(self.out(zero_padded(hidden, real[0])), real[0])
