"""Convolutions of channels-last sequences: torch's values, without its copies."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from motionloom.models.layers.conv import Conv, ConvEncoder, ConvTranspose

SHAPES = [
    {"kernel_size": 1},
    {"kernel_size": 3, "padding": 9, "dilation": 9},
    {"kernel_size": 4, "stride": 2, "padding": 1},
]


@pytest.mark.parametrize(
    ("ours", "theirs", "shape"),
    [*((Conv, nn.Conv1d, shape) for shape in SHAPES), (ConvTranspose, nn.ConvTranspose1d, SHAPES[-1])],
)
def test_values_and_gradients_are_those_of_torch(ours: Any, theirs: Any, shape: dict[str, int]) -> None:
    layer, other = ours(3, 5, **shape).double(), theirs(3, 5, **shape).double()
    other.load_state_dict(layer.state_dict())
    x = torch.randn(2, 12, 3, dtype=torch.double, requires_grad=True)
    again = x.detach().clone().requires_grad_()
    out, expected = layer(x), other(again.mT).mT
    weights = torch.randn_like(expected)
    (out * weights).sum().backward()
    (expected * weights).sum().backward()
    torch.testing.assert_close(out, expected)
    torch.testing.assert_close(x.grad, again.grad)
    for own, torchs in zip(layer.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(own.grad, torchs.grad)


class Copies(TorchDispatchMode):
    """Shapes of the tensors that are copied."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: list[tuple[int, ...]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ in ("clone", "copy_", "cat"):
            self.shapes.append(tuple(args[0].shape))
        return func(*args, **(kwargs or {}))


def test_no_sequence_is_copied_on_its_way() -> None:
    net = ConvEncoder(6, 8, width=8, halvings=2, depth=2, dilation_growth=3)
    with Copies() as copies:
        out: Tensor = net(torch.randn(4, 16, 6))
        out.square().sum().backward()
    assert out.is_contiguous()
    assert [shape for shape in copies.shapes if shape[0] == 4] == []  # gradients of weights are
