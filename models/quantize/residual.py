"""`ResidualQuantizer`: each level quantizes what the levels before it left (HumanTOMATO Algorithm 3)."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from motionloom.models.quantize.base import QuantizerOutput
from motionloom.models.quantize.ema import EmaQuantizer, QuantizerConfig


class ResidualQuantizer(nn.Module):
    """A stack of `EmaQuantizer`s; every level has its own codebook and its own commitment penalty.

    Args:
        config: Sizes and rates of each level.
        levels: Number of codebooks.
        salt: Number of the first level among the quantizers of one network.
    """

    def __init__(self, config: QuantizerConfig, levels: int, *, salt: int = 0) -> None:
        super().__init__()
        self.config = config
        self.levels = nn.ModuleList(EmaQuantizer(config, salt=salt + i) for i in range(levels))

    def level(self, index: int) -> EmaQuantizer:
        """One level's quantizer."""
        return cast(EmaQuantizer, self.levels[index])

    def freeze(self) -> None:
        """Stop updating for good, in training mode too."""
        for index in range(len(self.levels)):
            self.level(index).freeze()

    def forward(self, z: Tensor, mask: Tensor | None = None, *, update: bool = True) -> QuantizerOutput:
        """Quantize z [B, L, d]; codes [B, L, levels], penalty summed over levels, metrics [levels] each.

        The residual subtracts *detached* codes, so every level's penalty pulls z towards the sum of the codes
        so far.
        """
        total = torch.zeros_like(z, dtype=torch.float32)
        outputs = []
        for level in self.levels:
            residual = z.float() - total
            output = level(residual, mask, update=update)
            total = total + output.quantized.detach()
            outputs.append(output)
        full = z.float()
        return QuantizerOutput(
            (full + (total - full).detach()).to(z.dtype),
            torch.stack([output.codes for output in outputs], dim=-1),
            torch.stack([output.penalty for output in outputs]).sum(),
            {name: torch.stack([o.metrics[name] for o in outputs]) for name in outputs[0].metrics},
        )

    def vectors(self, codes: Tensor) -> Tensor:
        """Sum of the levels' code vectors, int64 [..., levels] -> float32 [..., d]."""
        parts = [self.level(i).vectors(codes[..., i]) for i in range(len(self.levels))]
        return torch.stack(parts).sum(0)
