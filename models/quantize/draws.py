"""Random rows of the global batch that every rank agrees on.

A draw is a hash of (salt, step, row number), not a random generator's state: the step is a registered buffer,
so a resumed run repeats the undisturbed one, no rank needs to broadcast, nothing is read back from the
device, and one process that sees the concatenated batch picks the same rows as many that see its parts.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.models.training.distributed import gather_rows, rank

_LAST = 2**62
"""Key of a row that must not be drawn; greater than every real key (at most 56 bits)."""


def _mix(x: Tensor) -> Tensor:
    """Avalanche of the low 32 bits (the finaliser of MurmurHash3), in int64 arithmetic."""
    x = x & 0xFFFFFFFF
    x = ((x ^ (x >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
    x = ((x ^ (x >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    return x ^ (x >> 16)


def draw_rows(rows: Tensor, mask: Tensor | None, count: int, *, salt: int, step: Tensor) -> Tensor:
    """This rank's share [count, d] of `count` random rows of the global batch; summed over ranks, the draw.

    Rows are drawn without replacement; when fewer than `count` exist they repeat in the same order.

    Args:
        rows: [n, d] of this rank; the global batch is the ranks' rows in rank order.
        mask: [n], False = never drawn; None = all may be.
        count: Number of rows wanted.
        salt: Tells quantizers apart, so that two of them do not draw the same rows.
        step: int64 scalar, a new one for every draw.
    """
    n = len(rows)
    number = torch.arange(n, device=rows.device) + rank() * n
    hashed = _mix(number ^ _mix(step ^ _mix(torch.full_like(step, salt + 1))))
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
