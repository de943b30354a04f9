"""The one contract of all quantizers: vectors in, a typed result out, codes <-> vectors."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class QuantizerOutput(NamedTuple):
    """What a quantizer returns."""

    quantized: Tensor
    """[B, L, d], straight-through: the value of the codes, the gradient of z."""
    codes: Tensor
    """int64 [B, L], or [B, L, levels]; meaningless where the mask is False."""
    penalty: Tensor
    """Commitment |z - sg(z_hat)|^2, mean over valid elements, float32 scalar; summed over residual levels.
    A codebook learnt by gradient adds the term that teaches it, and weighs both.
    While training, this rank's share: the mean over ranks is that of the global batch."""
    metrics: dict[str, Tensor]
    """float32 scalars ([levels] for a residual quantizer): `penalty`; `perplexity` of this batch's codes;
    `usage`, the share of codes this batch used; `dead`, codes whose EMA count is not above `reset_below`;
    `resets`, codes replaced in this step.
    Over the global batch while training, over this rank's otherwise."""


class Codebook(Protocol):
    """One vocabulary: what a tokenizer's users need of a quantizer."""

    @property
    def codebook(self) -> Tensor:
        """All code vectors, [K, d]."""

    def vectors(self, codes: Tensor) -> Tensor:
        """Code vectors, int64 [...] -> float32 [..., d]."""

    def freeze(self) -> None:
        """Stop updating for good, in training mode too."""


def usage_metrics(counts: Tensor, *, eps: float = 1e-7) -> dict[str, Tensor]:
    """`perplexity` and `usage` of how often each code was used, [K]; `eps` is within the logarithm (T2M-GPT's
    1e-7; UDE has 1e-10).
    """
    share = counts / counts.sum().clamp(min=1)
    return {
        "perplexity": torch.exp(-(share * torch.log(share + eps)).sum()),
        "usage": (counts > 0).float().mean(),
    }
