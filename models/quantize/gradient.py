"""`GradientQuantizer`: a codebook learnt by gradient, as UDE's (UDE section 3.1, equation 2).

Penalty: beta_1 |sg z - e|^2 + beta_2 |z - sg e|^2. The first term moves the codes to the latents, the second
the latents to the codes; both means are squared errors over elements, as in the public UDE code, which this
equals on codes, loss and perplexity.

Choices of ours:
- Codes start uniform in +-1/K, as public; `start: data` takes random rows of the first training batch
  instead, the same on every rank, as `EmaQuantizer` does [ours]. From the tiny uniform start nearly all
  latents share few codes for long, so short trainings use `data`.
- An EMA of uses per step is kept for the `dead` figure alone; no code is ever reset, so `resets` stays 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from motionloom.models.quantize.base import LearntCodebook, QuantizerConfig
from motionloom.models.training.distributed import sum_over_ranks

Start = Literal["uniform", "data"]


class GradientQuantizerConfig(QuantizerConfig):
    """One codebook; the defaults are UDE's (section 4.2)."""

    num_codes: int = Field(default=2048, ge=2)
    dim: int = Field(default=1024, ge=1)
    codebook_weight: float = Field(default=1.0, gt=0)
    """beta_1: how strongly codes are pulled to their latents."""
    commitment_weight: float = Field(default=1.0, ge=0)
    """beta_2: how strongly latents are pulled to their codes."""
    start: Start = "uniform"
    """Where codes start: within +-1/K (public UDE), or on rows of the first batch [ours]."""


class GradientQuantizer(LearntCodebook):
    """Nearest code, straight-through; see the module docstring.

    The codebook is a parameter. It gets its gradient from the penalty alone: the output passes its gradient
    on to z.

    Args:
        salt: See `LearntCodebook`.
    """

    config: GradientQuantizerConfig
    usage_eps = 1e-10

    def __init__(self, config: GradientQuantizerConfig, *, salt: int = 0) -> None:
        bound = 1 / config.num_codes
        codes = nn.Parameter(torch.empty(config.num_codes, config.dim).uniform_(-bound, bound))
        super().__init__(config, codes, initialised=config.start == "uniform", salt=salt)

    def _wide(self, dtype: torch.dtype) -> torch.dtype:
        return torch.promote_types(dtype, torch.float32)

    def _penalty(self, latents: Tensor, near: Tensor, mean_square: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the weighted sum of both terms."""
        to_latents = mean_square(near - latents.detach())
        to_codes = mean_square(latents - near.detach())
        return self.config.codebook_weight * to_latents + self.config.commitment_weight * to_codes

    def vectors(self, codes: Tensor) -> Tensor:
        """Code vectors, int64 [...] -> [..., d], float32 or the wider type of the codebook."""
        chosen = functional.embedding(codes, self.codebook)
        return chosen.to(torch.promote_types(chosen.dtype, torch.float32))

    @torch.no_grad()
    def _update(self, rows: Tensor, mask: Tensor, codes: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        counts = sum_over_ranks(counts)
        # A batch without vectors does not tell which codes are used.
        rate = torch.where(counts.sum() > 0, 1 - self.config.decay, 0.0).to(self.ema_count.dtype)
        self.ema_count.lerp_(counts.to(self.ema_count.dtype), rate)
        return counts, counts.new_zeros(())
