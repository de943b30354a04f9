"""Running sums that a GPU repeats."""

from __future__ import annotations

import torch
from torch import Tensor


def running_sum(x: Tensor, dim: int) -> Tensor:
    """Sums along `dim` up to each element; unlike `cumsum`, the same every time on a GPU."""
    if x.device.type == "cpu":
        return x.cumsum(dim)
    size = x.shape[dim]
    reach = 1
    while reach < size:  # each sum reaches twice as far back
        farther = x.narrow(dim, reach, size - reach) + x.narrow(dim, 0, size - reach)
        x = torch.cat([x.narrow(dim, 0, reach), farther], dim)
        reach *= 2
    return x
