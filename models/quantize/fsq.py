"""`FsqQuantizer`: finite scalar quantization (Mentzer et al. 2023), an alternative to codebooks.

A latent is projected to a few scalars, each bounded by tanh and rounded to one of its steps; the code is the
mixed-radix number of the roundings. There is no codebook to learn, hence no commitment, no dead codes, no
resets and nothing to synchronise between ranks.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.models.quantize.base import QuantizerOutput, code_sums, usage_metrics
from motionloom.models.training.distributed import sum_over_ranks

_MARGIN = 1e-3
"""Keeps the outermost value of each scalar reachable: tanh itself never gets to 1."""


class FsqQuantizer(nn.Module):
    """Projection, rounding, projection.

    Args:
        steps: Number of values of each scalar; the number of codes is their product.
    """

    steps: Tensor
    radix: Tensor

    def __init__(self, dim: int, steps: tuple[int, ...]) -> None:
        super().__init__()
        self.num_codes = math.prod(steps)
        self.enter = nn.Linear(dim, len(steps))
        self.leave = nn.Linear(len(steps), dim)
        radix = [math.prod(steps[:i]) for i in range(len(steps))]
        self.register_buffer("steps", torch.tensor(steps), persistent=False)
        self.register_buffer("radix", torch.tensor(radix), persistent=False)

    @property
    def codebook(self) -> Tensor:
        return self.vectors(torch.arange(self.num_codes, device=self.steps.device))

    def freeze(self) -> None:
        """Nothing is updated outside the optimizer."""

    def forward(self, z: Tensor, mask: Tensor | None = None, *, update: bool = True) -> QuantizerOutput:
        """Quantize z [B, L, d]; `mask` [B, L] False = padding, which is not counted.

        There is nothing to update; without `update` the metrics are this rank's, as in evaluation.
        The rounding is straight-through and float32 under autocast too.
        """
        with torch.autocast(z.device.type, enabled=False):
            bounded = self._bound(_linear(self.enter, z))
            rounded = bounded + (bounded.round() - bounded).detach()
            half = self.steps // 2
            digits = (rounded.detach().long() + half).clamp(min=0)
            codes = (digits * self.radix).sum(-1)
            quantized = _linear(self.leave, rounded / half)
            used = torch.ones_like(codes, dtype=torch.float32) if mask is None else mask.float()
            counts = code_sums(used.flatten(), codes.flatten(), self.num_codes)
            if self.training and update:
                counts = sum_over_ranks(counts)
        zero = counts.new_zeros(())
        metrics = {"penalty": zero, **usage_metrics(counts), "dead": zero, "resets": zero}
        return QuantizerOutput(quantized.to(z.dtype), codes, zero, metrics)

    def vectors(self, codes: Tensor) -> Tensor:
        digits = codes[..., None] // self.radix % self.steps
        half = self.steps // 2
        return _linear(self.leave, (digits - half) / half)

    def _bound(self, z: Tensor) -> Tensor:
        """Scalars into the open range whose roundings are exactly the steps."""
        half = (self.steps - 1) * (1 + _MARGIN) / 2
        offset = torch.where(self.steps % 2 == 0, 0.5, 0.0)
        return (z + (offset / half).atanh()).tanh() * half - offset


def _linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """In float32 whatever the layer was cast to."""
    bias = None if layer.bias is None else layer.bias.float()
    return functional.linear(x.float(), layer.weight.float(), bias)
