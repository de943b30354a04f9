"""What all quantizers have in common: padding, freezing, one graph."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn

from motionloom.models.quantize.base import QuantizerConfig, nearest
from motionloom.models.quantize.ema import EmaQuantizer, ResidualQuantizer
from motionloom.models.quantize.fsq import FsqQuantizer
from motionloom.models.quantize.gradient import GradientQuantizer, GradientQuantizerConfig

SMALL = QuantizerConfig(num_codes=6, dim=4)
KINDS: dict[str, Callable[[], nn.Module]] = {
    "ema": lambda: EmaQuantizer(SMALL),
    "residual": lambda: ResidualQuantizer(SMALL, 2),
    "gradient": lambda: GradientQuantizer(GradientQuantizerConfig(num_codes=6, dim=4)),
    "gradient from data": lambda: GradientQuantizer(
        GradientQuantizerConfig(num_codes=6, dim=4, start="data")
    ),
    "fsq": lambda: FsqQuantizer(4, (4, 4)),
}


@pytest.fixture(params=list(KINDS))
def make(request: pytest.FixtureRequest) -> Callable[[], nn.Module]:
    torch.manual_seed(0)
    return KINDS[request.param]


@pytest.mark.parametrize("padding", [7.0, float("nan")])
def test_masked_batch_equals_truncated_batch(make: Callable[[], nn.Module], padding: float) -> None:
    padded, plain = make(), make()
    padded.load_state_dict(plain.state_dict())
    mask = torch.arange(17)[None] < 12
    for _ in range(4):
        z = torch.randn(1, 12, 4)
        wide = torch.cat([z, torch.full((1, 5, 4), padding)], 1).requires_grad_()
        a, b = padded(wide, mask), plain(z)
        assert torch.equal(a.codes[:, :12], b.codes)
        torch.testing.assert_close(a.penalty, b.penalty)
        for name, value in b.metrics.items():
            torch.testing.assert_close(a.metrics[name], value)
        if a.penalty.requires_grad and padding == 7.0:
            a.penalty.backward()
            assert wide.grad is not None and (wide.grad[:, 12:] == 0).all()
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(padded.state_dict()[name], value)


def test_the_first_of_codes_that_are_equally_near_is_taken() -> None:
    """Whatever the order of sums: codes that differ by rounding share no rows, others have their own."""
    torch.manual_seed(0)
    rows, codes = torch.randn(400, 64) * 5, torch.randn(40, 64) * 5
    doubled = torch.cat([codes, codes * (1 + 1e-7 * torch.randn(40, 1))])
    found = nearest(rows, doubled)
    assert torch.equal(found, nearest(rows, codes)) and found.max() < 40
    assert torch.equal(found, torch.cdist(rows.double(), codes.double()).argmin(1))
