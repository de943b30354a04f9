"""Finite scalar quantization against an independent implementation, and its contract."""

from __future__ import annotations

import pytest
import torch
from vector_quantize_pytorch import FSQ

from motionloom.models.quantize.fsq import FsqQuantizer

STEPS = [(8, 5, 5, 5), (4, 4), (3,), (3, 7)]


def plain(steps: tuple[int, ...]) -> FsqQuantizer:
    """With identity projections, so that only the rounding is left."""
    quantizer = FsqQuantizer(len(steps), steps)
    for linear in (quantizer.enter, quantizer.leave):
        torch.nn.init.eye_(linear.weight)
        torch.nn.init.zeros_(linear.bias)
    return quantizer


@pytest.mark.parametrize("steps", STEPS)
def test_equals_an_independent_implementation(steps: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    z = torch.randn(4, 50, len(steps)) * 2
    ours, theirs = plain(steps), FSQ(list(steps))
    wanted, codes = theirs(z)
    out = ours(z)
    torch.testing.assert_close(out.quantized, wanted)
    assert torch.equal(out.codes, codes.long())
    torch.testing.assert_close(ours.codebook, theirs.implicit_codebook)


@pytest.mark.parametrize("steps", STEPS)
def test_every_code_is_reached_and_comes_back(steps: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    quantizer = plain(steps)
    z = torch.randn(1, 60_000, len(steps)) * 1.5
    out = quantizer(z)
    assert len(out.codes.unique()) == quantizer.num_codes
    torch.testing.assert_close(quantizer.vectors(out.codes), out.quantized.detach())
    assert out.metrics["usage"] == 1
    assert out.metrics["dead"] == out.metrics["resets"] == out.penalty == 0


def test_gradient_passes_the_rounding() -> None:
    torch.manual_seed(0)
    quantizer = plain((5, 5))
    z = torch.zeros(1, 1, 2, requires_grad=True)
    quantizer(z).quantized.sum().backward()
    # Slope of the bound at 0, (L - 1) / 2 x (1 + margin), over the half width L // 2.
    torch.testing.assert_close(z.grad, torch.full_like(z, 2 * 1.001 / 2))
