"""`EmaQuantizer`: a codebook learnt by exponential moving averages and Code Reset, never by gradient.

HumanTOMATO section 3.2 and B.2 (K = 512, d = 512, decay 0.99), after VQ-VAE-2 and T2M-GPT. It equals the
public T2M-GPT quantizer on codes, outputs, penalty, gradient, perplexity and the EMA update. It differs on
purpose where a code is reset:

- A reset code takes a *random* row of the *global* batch (there: row k of the local batch for code k), the
  same on every rank.
- Its EMA count becomes the threshold and its EMA sum row x count (there: both stay stale, so the next update
  pulls the code back to where it was dead).
- The first batch initialises the codebook with random rows (there: the first K), with the same count.

`reset_below` is an EMA of uses per step: K x `reset_below` must stay well below the vectors of one global
batch, or most of the codebook is replaced at every step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Self, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from motionloom.models.quantize.base import LearntCodebook, QuantizerConfig, QuantizerOutput, code_sums
from motionloom.models.training.distributed import is_distributed, sum_over_ranks


class EmaQuantizer(LearntCodebook):
    """Nearest code, straight-through; see the module docstring.

    All state is in buffers (`codebook`, `ema_sum`, `ema_count`, `initialised`, `draws`) and is float32
    whatever the model is cast to; the arithmetic is float32 under autocast too.

    Args:
        salt: See `LearntCodebook`.
    """

    ema_sum: Tensor

    def __init__(self, config: QuantizerConfig, *, salt: int = 0) -> None:
        # Random, so that an untrained tokenizer decodes to something; the first training batch replaces it.
        codes = torch.randn(config.num_codes, config.dim) * config.dim**-0.5
        super().__init__(config, codes, initialised=False, salt=salt)
        self.register_buffer("ema_sum", codes * config.reset_below)

    def _wide(self, dtype: torch.dtype) -> torch.dtype:
        return torch.float32

    def _penalty(self, latents: Tensor, near: Tensor, mean_square: Callable[[Tensor], Tensor]) -> Tensor:
        return mean_square(latents - near)

    def vectors(self, codes: Tensor) -> Tensor:
        return functional.embedding(codes, self.codebook)

    @torch.no_grad()
    def _initialise(self, rows: Tensor, mask: Tensor) -> None:
        super()._initialise(rows, mask)
        self.ema_sum.copy_(self.codebook * self.config.reset_below)
        self.ema_count.fill_(self.config.reset_below)

    @torch.no_grad()
    def _update(self, rows: Tensor, mask: Tensor, codes: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """EMA step and Code Reset from the global batch; returns its counts [K] and the number of resets."""
        sums = code_sums(rows, codes, self.config.num_codes)  # padded rows are zero
        fresh = self._draw(rows, mask)
        if is_distributed():
            packed = sum_over_ranks(torch.cat([sums, fresh, counts[:, None]], dim=1))
            dim = self.config.dim
            sums = packed[:, :dim]
            fresh = packed[:, dim:-1]
            counts = packed[:, -1]
        floor = self.config.reset_below
        # A batch without vectors (no clip of it has hands) teaches nothing: everything stays as it is.
        rate = torch.where(counts.sum() > 0, 1 - self.config.decay, 0.0)
        # lerp: decay * floor + (1 - decay) * floor may round below the floor and reset a code in steady use
        self.ema_count.lerp_(counts, rate)
        self.ema_sum.lerp_(sums, rate)
        reset = self.ema_count < floor
        self.ema_count.masked_fill_(reset, floor)
        self.ema_sum.copy_(torch.where(reset[:, None], fresh * floor, self.ema_sum))
        self.codebook.copy_(torch.where(reset[:, None], fresh, self.ema_sum / self.ema_count[:, None]))
        return counts, reset.sum().float()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Follow moves between devices, refuse casts: a bfloat16 EMA would stop moving."""
        kept = {name: buffer for name, buffer in self._buffers.items() if buffer is not None}
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        for name, before in kept.items():
            after = getattr(self, name)
            if after.dtype != before.dtype:
                setattr(self, name, before.to(after.device))
        return self


class ResidualQuantizer(nn.Module):
    """A stack of `EmaQuantizer`s; every level has its own codebook and its own commitment penalty.

    Args:
        salt: Number of the first level among the quantizers of one network.
    """

    def __init__(self, config: QuantizerConfig, levels: int, *, salt: int = 0) -> None:
        super().__init__()
        self.config = config
        self.levels = nn.ModuleList(EmaQuantizer(config, salt=salt + i) for i in range(levels))

    def level(self, index: int) -> EmaQuantizer:
        return cast(EmaQuantizer, self.levels[index])

    def freeze(self) -> None:
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
