"""Linear layers of widths that are no multiple of eight, such as motion features or tokens with their End.

Half-precision matrix products on a GPU read rows of a multiple of eight numbers; others take a kernel that is
several times slower [on an H200 the 313 columns of a motion took 46 TFLOP/s, 256 columns over 600].
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def product_type(x: Tensor) -> torch.dtype:
    """The type in which matrix products of x are computed, under autocast or without."""
    device = x.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else x.dtype


class Linear(nn.Linear):
    """`nn.Linear` whose weights are filled up with zeros where a GPU computes in half precision."""

    def forward(self, x: Tensor) -> Tensor:
        uneven = self.in_features % 8 or self.out_features % 8
        if x.is_cuda and uneven and product_type(x) in (torch.float16, torch.bfloat16):
            return self.filled_up(x)
        return super().forward(x)

    def filled_up(self, x: Tensor) -> Tensor:
        """The same [..., out_features] of x [..., in_features], by a product of even sizes."""
        columns = -self.in_features % 8
        rows = -self.out_features % 8
        x = F.pad(x.to(product_type(x)), (0, columns))
        bias = None if self.bias is None else F.pad(self.bias, (0, rows))
        out = F.linear(x, F.pad(self.weight, (0, columns, 0, rows)), bias)
        return out[..., : self.out_features]
