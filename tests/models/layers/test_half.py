"""Half precision: gradients are those of float64 up to the rounding of bfloat16."""

from __future__ import annotations

import copy

import torch
from torch import nn

from motionloom.models.layers.transformer import StackConfig, Transformer


class Sizes(StackConfig):
    dim: int = 32
    heads: int = 4
    ff: int = 64
    dropout: float = 0.0


def gradients(net: nn.Module, x: torch.Tensor, mask: torch.Tensor) -> dict[str, torch.Tensor]:
    with torch.autocast("cpu", torch.bfloat16, enabled=x.dtype != torch.double, cache_enabled=False):
        out = net(x, mask)
    (out.double() * mask[..., None]).square().mean().backward()
    return {name: param.grad.double() for name, param in net.named_parameters() if param.grad is not None}


def test_gradients_of_normalisation_are_added_up_in_float32() -> None:
    torch.manual_seed(0)
    net = Transformer(Sizes(), 2, norm="post")
    x, mask = torch.randn(64, 48, 32), torch.arange(48) < torch.randint(8, 49, (64, 1))
    true = gradients(copy.deepcopy(net).double(), x.double(), mask)
    for name, found in gradients(net, x.bfloat16(), mask).items():  # as a linear layer before gives it
        assert (found - true[name]).norm() < 0.05 * true[name].norm(), name
