"""The few collectives the models need; each is the identity when no process group is running.

Losses are written so that their *mean over ranks* is the loss of the concatenated batch: DDP and FSDP average
gradients over ranks, and training then equals one process with the whole batch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

_alone = False


@contextmanager
def alone() -> Iterator[None]:
    """Context in which no collective is called although a process group exists."""
    global _alone
    before = _alone
    _alone = True
    try:
        yield
    finally:
        _alone = before


def is_distributed() -> bool:
    """True inside a process group of more than one rank, unless this process works `alone`."""
    return not _alone and dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def world_size() -> int:
    """Number of ranks."""
    return dist.get_world_size() if is_distributed() else 1


def rank() -> int:
    """This rank."""
    return dist.get_rank() if is_distributed() else 0


def sum_over_ranks(x: Tensor) -> Tensor:
    """Sum of `x` over ranks, without gradient (codebook statistics, metric counts)."""
    if is_distributed():
        x = x.clone()
        dist.all_reduce(x)
    return x


class _Summed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return sum_over_ranks(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return sum_over_ranks(grad)


def sum_over_ranks_with_grad(x: Tensor) -> Tensor:
    """Sum of `x` over ranks, for losses that differ from rank to rank: the backward pass sums gradients."""
    summed: Tensor = _Summed.apply(x) if is_distributed() else x  # type: ignore[no-untyped-call]
    return summed


def masked_mean(values: Tensor, mask: Tensor, present: Tensor | None = None) -> Tensor:
    """Return this rank's share of the mean of `values` where `mask` is True; 0 where there are none.

    The mean of the shares over ranks is the mean over the whole batch: ranks hold different numbers of real
    frames or tokens, so each divides by the mean number per rank, not by its own.

    Args:
        values: Any shape.
        mask: bool, the shape of `values` or of its leading dimensions.
        present: For values [B, T, D] and mask [B, T]: bool [B, D], columns of a row that count; None = all.
    """
    each = math.prod(values.shape[mask.dim() :])
    number = mask.sum().float()
    if present is not None:
        # Two masks of fewer dimensions keep the layout of `values`, hence the order of the sum.
        values = torch.where(present[:, None], values, 0.0)
        number = (mask.sum(1) * present.float().mean(1)).sum()
    count = (sum_over_ranks(number) * each).clamp(min=1) / world_size()
    full = mask[(...,) + (None,) * (values.dim() - mask.dim())]
    return torch.where(full, values, 0.0).sum() / count


def mean_of_rows(values: Tensor, mask: Tensor, present: Tensor | None = None) -> Tensor:
    """Mean over the rows of values [B, T, D] of each row's own mean where mask [B, T] is True: short clips
    count as long ones do. `present` and ranks as in `masked_mean`; a row without columns counts for nothing.
    """
    columns = torch.ones_like(values[:, 0], dtype=torch.bool) if present is None else present
    number = mask.sum(1) * columns.sum(1)
    full = mask[..., None] & columns[:, None]
    rows = torch.where(full, values, 0.0).sum((1, 2)) / number.clamp(min=1)
    return masked_mean(rows, number > 0)


def gather_rows(x: Tensor) -> Tensor:
    """Rows of every rank in rank order, [W*B, ...], without gradient. Every rank must hold the same shape."""
    if not is_distributed():
        return x
    parts = [torch.empty_like(x) for _ in range(world_size())]
    dist.all_gather(parts, x.contiguous())
    return torch.cat(parts)


def gather_rows_with_grad(x: Tensor) -> Tensor:
    """`gather_rows` for a loss that every rank computes from the same rows (contrastive negatives).

    The gradient of this rank's rows is multiplied by the number of ranks, so that the mean of gradients over
    ranks is the gradient of one process. No collective runs in the backward pass.
    """
    if not is_distributed():
        return x
    rows = list(torch.split(gather_rows(x.detach()), len(x)))
    rows[rank()] = x + (world_size() - 1) * (x - x.detach())
    return torch.cat(rows)


def mean_gradients(params: Sequence[nn.Parameter]) -> None:
    """Average gradients over ranks in place, as DDP does; every rank calls it with the same parameters.

    A missing gradient counts as 0, unless all ranks lack it: then the optimizer skips the parameter, as in
    one process. One collective for each dtype.
    """
    if not is_distributed():
        return
    for dtype in dict.fromkeys(param.dtype for param in params):
        group = [param for param in params if param.dtype == dtype]
        present = torch.tensor([float(p.grad is not None) for p in group], dtype=dtype).to(group[0].device)
        grads = [(p.grad if p.grad is not None else torch.zeros_like(p)).reshape(-1) for p in group]
        flat = torch.cat([present, *grads])
        dist.all_reduce(flat)
        means = torch.split(flat[len(group) :] / world_size(), [p.numel() for p in group])
        # Read only where this rank lacks one: on a GPU that waits for the collective.
        lacking = any(param.grad is None for param in group)
        counts = flat[: len(group)].tolist() if lacking else [1.0] * len(group)
        for param, count, mean in zip(group, counts, means, strict=True):
            param.grad = mean.view_as(param) if count else None
