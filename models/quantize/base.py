"""The kernel of all quantizers: their result, usage metrics, and random rows that every rank agrees on.

Random rows of the global batch are chosen by a hash of (salt, step, row number) instead of a generator's
state. The step is a registered buffer, so a resumed run repeats the undisturbed one; no rank needs to
broadcast, nothing is read back from the device, and one process that sees the concatenated batch picks the
same rows as many that see its parts.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from motionloom.datasets.base.config import Config
from motionloom.models.training.distributed import gather_rows, rank, sum_over_ranks, world_size

_LAST = 2**62
"""Key of a row that must not be drawn; greater than every real key (at most 56 bits)."""


class QuantizerOutput(NamedTuple):
    """The result of a quantizer."""

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


class QuantizerConfig(Config):
    """One learnt codebook."""

    num_codes: int = Field(default=512, ge=2)
    dim: int = Field(default=512, ge=1)
    decay: float = Field(default=0.99, gt=0, lt=1)
    """EMA constant lambda."""
    reset_below: float = Field(default=1.0, gt=0)
    """A code whose EMA count falls below this is reset (`EmaQuantizer`), or counted as dead."""


class Codebook(Protocol):
    """One vocabulary: what a tokenizer's users need of a quantizer."""

    @property
    def codebook(self) -> Tensor:
        """All code vectors, [K, d]."""

    def vectors(self, codes: Tensor) -> Tensor:
        """Code vectors, int64 [...] -> float32 [..., d]."""

    def freeze(self) -> None:
        """Stop updating for good, in training mode too."""


class LearntCodebook(nn.Module):
    """Base of codebooks learnt from data: buffers, first codes drawn from a batch, nearest codes, freezing.

    Args:
        codebook: First codes [K, d], a parameter where it is learnt by gradient.
        initialised: False has the first training batch replace them.
        salt: Number of this quantizer among those of one network (each draws its own random rows).
    """

    codebook: Tensor
    ema_count: Tensor
    initialised: Tensor
    draws: Tensor
    usage_eps: ClassVar[float] = 1e-7
    """The `eps` of `usage_metrics`."""

    def __init__(self, config: QuantizerConfig, codebook: Tensor, *, initialised: bool, salt: int) -> None:
        super().__init__()
        self.config = config
        self.salt = salt
        self.frozen = False
        if isinstance(codebook, nn.Parameter):
            self.codebook = codebook
        else:
            self.register_buffer("codebook", codebook)
        self.register_buffer("ema_count", torch.full((config.num_codes,), config.reset_below))
        self.register_buffer("initialised", torch.tensor(initialised))
        self.register_buffer("draws", torch.tensor(0))
        # Mirror of `initialised`: reading the buffer at every step would wait for the device.
        self._is_initialised = initialised

    def freeze(self) -> None:
        self.frozen = True
        self.codebook.requires_grad_(False)

    def forward(self, z: Tensor, mask: Tensor | None = None, *, update: bool = True) -> QuantizerOutput:
        """Quantize z [B, L, d] by the nearest codes, straight-through, in float32 under autocast too.

        Args:
            z: Latents of any float type; the output has the same.
            mask: [B, L], False = padding: neither counted nor learnt from, and outside the penalty.
            update: False keeps the codebook as it is. It also stays in eval mode and when frozen.
        """
        update = update and self.training and not self.frozen
        with torch.autocast(z.device.type, enabled=False):
            full = z.to(self._wide(z.dtype))
            rows = full.detach().reshape(-1, full.shape[-1])
            real = torch.ones_like(rows[:, 0], dtype=torch.bool) if mask is None else mask.reshape(-1)
            rows = rows.masked_fill(~real[:, None], 0.0)
            if update and not self._is_initialised:
                self._initialise(rows, real)
            codebook = self.codebook.to(full.dtype)
            codes = nearest(rows, codebook.detach())
            chosen = functional.embedding(codes, codebook).view_as(full)
            counts = code_sums(real.float(), codes, self.config.num_codes)
            # Both sides are masked before they meet: a padded NaN would otherwise be in the gradient.
            outside = ~real.view(z.shape[:-1])[..., None]
            latents = full.masked_fill(outside, 0.0)
            near = chosen.masked_fill(outside, 0.0)
            resets = counts.new_zeros(())
            if update:
                counts, resets = self._update(rows, real, codes, counts)
            # The counts are global after an update: dividing by their mean per rank makes the mean over ranks
            # the penalty of the whole batch, whatever each rank's number of real vectors is.
            number = (counts.sum() * full.shape[-1]).clamp(min=1) / (world_size() if update else 1)

            def mean_square(error: Tensor) -> Tensor:
                return error.square().sum() / number

            penalty = self._penalty(latents, near, mean_square)
            metrics = {
                "penalty": penalty.detach().float(),
                **usage_metrics(counts, eps=self.usage_eps),
                "dead": (self.ema_count <= self.config.reset_below).sum().float(),
                "resets": resets,
            }
            error = full - chosen
            straight = full - error.detach()
        return QuantizerOutput(straight.to(z.dtype), codes.view(z.shape[:-1]), penalty, metrics)

    @abstractmethod
    def _wide(self, dtype: torch.dtype) -> torch.dtype:
        """Return the type that latents of a type are quantized in."""

    @abstractmethod
    def _update(self, rows: Tensor, mask: Tensor, codes: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Learn from this rank's real rows [n, d]; return global counts [K] and the number of resets."""

    @abstractmethod
    def _penalty(self, latents: Tensor, near: Tensor, mean_square: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the penalty of latents [B, L, d] and their codes, both 0 at padding."""

    @torch.no_grad()
    def _draw(self, rows: Tensor, mask: Tensor) -> Tensor:
        drawn = draw_rows(rows, mask, self.config.num_codes, salt=self.salt, step=self.draws)
        self.draws.add_(1)
        return drawn

    @torch.no_grad()
    def _initialise(self, rows: Tensor, mask: Tensor) -> None:
        drawn = sum_over_ranks(self._draw(rows, mask))
        # Of a batch without vectors nothing is drawn; Code Reset then replaces the random codes one by one.
        some = sum_over_ranks(mask.any().float()) > 0
        self.codebook.copy_(torch.where(some, drawn.to(self.codebook.dtype), self.codebook))
        self.initialised.fill_(True)
        self._is_initialised = True

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._is_initialised = bool(self.initialised)


def code_sums(values: Tensor, codes: Tensor, num_codes: int) -> Tensor:
    """Sums of the values [n] or [n, d] of each code, [K] or [K, d]; codes int64 [n]."""
    if values.device.type == "cpu":
        return values.new_zeros(num_codes, *values.shape[1:]).index_add_(0, codes, values)
    # On a GPU that adds in any order. A product with one-hot rows does not, and costs less than sorting.
    chosen = torch.arange(num_codes, device=codes.device)[:, None] == codes
    return chosen.to(values.dtype) @ values


def usage_metrics(counts: Tensor, *, eps: float = 1e-7) -> dict[str, Tensor]:
    """`perplexity` and `usage` of code counts [K]; `eps` in the logarithm (T2M-GPT: 1e-7, UDE: 1e-10)."""
    share = counts / counts.sum().clamp(min=1)
    return {
        "perplexity": torch.exp(-(share * torch.log(share + eps)).sum()),
        "usage": (counts > 0).float().mean(),
    }


def draw_rows(rows: Tensor, mask: Tensor | None, count: int, *, salt: int, step: Tensor) -> Tensor:
    """This rank's share [count, d] of `count` random rows of the global batch; summed over ranks, the draw.

    Rows are drawn without replacement; when fewer than `count` exist they repeat in the same order.

    Args:
        rows: [n, d] of this rank; the global batch is the ranks' rows in rank order.
        mask: [n], False = never drawn; None = all may be.
        salt: Tells quantizers apart, so that two of them do not draw the same rows.
        step: int64 scalar, a new one for every draw.
    """
    n = len(rows)
    number = torch.arange(n, device=rows.device) + rank() * n
    hashed = hash32(number ^ hash32(step ^ hash32(torch.full_like(step, salt + 1))))
    keys = hashed * 2**24 + number  # the row number makes keys unique, so the order is total
    if mask is not None:
        keys = keys.masked_fill(~mask, _LAST)
    smallest, local = keys.topk(min(count, n), largest=False)
    if n < count:
        smallest = torch.cat([smallest, smallest.new_full((count - n,), _LAST)])
    everyone = gather_rows(smallest)
    chosen, slot = everyone.topk(count, largest=False)
    usable = (chosen < _LAST).sum().clamp(min=1)
    slot = slot[torch.arange(count, device=rows.device) % usable]
    mine = slot - rank() * count
    picked = rows[local[mine.clamp(0, len(local) - 1)]]
    return torch.where(((mine >= 0) & (mine < len(local)))[:, None], picked, 0.0)


_TIE = 4e-6
"""Rounding of a dot product of some hundred float32 numbers, relative to the squares of both sides."""


def nearest(z: Tensor, codebook: Tensor) -> Tensor:
    """Index of the nearest code by squared distance; z [n, d], codebook [K, d] -> int64 [n].

    Of codes that are equally near up to rounding it is the first: a young codebook holds many that are almost
    the same, and which of them were used, hence which are reset, must not depend on the order of sums, which
    another number of processes changes.
    """
    # |z|^2 does not change the order, so one matmul with |e|^2 as its bias is the whole distance.
    norms = codebook.square().sum(1)
    distances = torch.addmm(norms, z, codebook.t(), alpha=-2)
    most = distances.amin(1) + _TIE * (z.square().sum(1) + norms.max())
    return (distances <= most[:, None]).to(torch.uint8).argmax(1)


def hash32(x: Tensor) -> Tensor:
    """Avalanche of the low 32 bits of int64 (the finaliser of MurmurHash3): uniform in 0 .. 2^32 - 1."""
    x = x & 0xFFFFFFFF
    x = ((x ^ (x >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
    x = ((x ^ (x >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    return x ^ (x >> 16)
