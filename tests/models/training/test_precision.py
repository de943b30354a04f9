"""Mixed precision: every stage trains under autocast with finite losses near the float32 ones, and what must
be float32 is.

What learns by averages (codebooks) or exponentiates (InfoNCE, KL, logits) is kept out of the half types:
inputs are made that only float32 gets right.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from rank_cases import CASES as CASES_OF_RANKS
from torch import Tensor

from motionloom.models.quantize.base import QuantizerConfig
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.quantize.fsq import FsqQuantizer
from motionloom.models.tma.losses import info_nce, kl_four
from motionloom.models.training.stage_module import StageModule

STEPS = 4
HALVES = [torch.bfloat16, torch.float16]
CASES = ("h2vq", "rvq", "fsq", "tma", "mdm", "gpt")


def build(case: str) -> tuple[StageModule, dict[str, Any]]:
    torch.manual_seed(0)
    module, batches = CASES_OF_RANKS[case]()
    return module, in_float32(batches(0))


def in_float32(batch: Any) -> Any:
    if isinstance(batch, dict):
        return {name: in_float32(value) for name, value in batch.items()}
    if isinstance(batch, tuple):
        return type(batch)(*map(in_float32, batch))
    return batch.float() if batch is not None and batch.is_floating_point() else batch


def train(case: str, half: torch.dtype | None) -> tuple[StageModule, list[dict[str, Tensor]]]:
    """A few steps on one batch, as Lightning makes them: forward and losses under autocast, the rest outside.

    float16 takes the gradient of a scaled loss, as behind a gradient scaler.
    """
    module, batch = build(case)
    module.fused = half != torch.float16
    optimizer = module.configure_optimizers()[0]["optimizer"]
    scale = 1024.0 if half == torch.float16 else 1.0
    found = []
    for step in range(STEPS):
        torch.manual_seed(step)
        with torch.autocast("cpu", half or torch.bfloat16, enabled=half is not None):
            values = module.losses(batch)
        optimizer.zero_grad()
        (values["loss"] * scale).backward()
        for parameter in module.net.parameters():
            if parameter.grad is not None:
                parameter.grad /= scale
        optimizer.step()
        found.append({name: value.detach() for name, value in values.items()})
    return module, found


@pytest.mark.parametrize("half", HALVES, ids=str)
@pytest.mark.parametrize("case", CASES)
def test_a_few_steps_are_near_those_in_float32(case: str, half: torch.dtype) -> None:
    before = {name: (v.dtype, v.is_floating_point()) for name, v in build(case)[0].net.state_dict().items()}
    module, found = train(case, half)
    _, expected = train(case, None)
    for step in range(STEPS):
        for name, value in found[step].items():
            assert torch.isfinite(value).all(), (name, step)
            assert value.dtype == torch.float32, name
    for step, (mixed, full) in enumerate(zip(found, expected, strict=True)):
        assert mixed["loss"].item() == pytest.approx(full["loss"].item(), rel=0.03), step
    state = module.net.state_dict()
    for name, (dtype, floating) in before.items():
        assert state[name].dtype == dtype
        assert not floating or (dtype == torch.float32 and torch.isfinite(state[name]).all()), name
    assert all(p.grad is None or p.grad.dtype == torch.float32 for p in module.net.parameters())


def autocast(half: torch.dtype) -> torch.autocast:
    return torch.autocast("cpu", half)


@pytest.mark.parametrize("half", HALVES, ids=str)
def test_codes_are_assigned_in_float32(half: torch.dtype) -> None:
    """Codes four thousandths apart, far from zero: bfloat16 and float16 would call them the same."""
    quantizer = EmaQuantizer(QuantizerConfig(num_codes=16, dim=4)).eval()
    quantizer.codebook.copy_(1 + torch.arange(16)[:, None] * 4e-3)
    z = quantizer.codebook[None] + 2e-4
    fsq = FsqQuantizer(4, (5, 4))
    wide = torch.randn(1, 200, 4) * 3
    plain = fsq(wide).codes
    with autocast(half):
        out = quantizer(z)
        assert torch.equal(out.codes[0], torch.arange(16))
        assert out.quantized.dtype == out.penalty.dtype == torch.float32
        assert torch.equal(fsq(wide).codes, plain)
        assert quantizer.vectors(out.codes).dtype == torch.float32


@pytest.mark.parametrize("bad", [float("inf"), float("nan")])
def test_an_overflow_does_not_stay_in_the_codebook(bad: float) -> None:
    """float16 overflows now and then; the scaler leaves the step out, the codebook leaves the vector out."""
    torch.manual_seed(0)
    quantizer, same = (EmaQuantizer(QuantizerConfig(num_codes=4, dim=2, reset_below=0.1)) for _ in range(2))
    same.load_state_dict(quantizer.state_dict())
    z = torch.randn(2, 20, 2)
    mask = torch.ones(2, 20, dtype=torch.bool)
    mask[1, 3] = False
    for _ in range(3):
        broken = z.clone()
        broken[1, 3] = bad
        out, expected = quantizer(broken), same(z, mask)
        assert torch.equal(out.penalty, expected.penalty)
        assert not torch.isfinite(out.quantized[1, 3]).all()  # the loss still shows it
    for name, value in same.state_dict().items():
        assert torch.equal(quantizer.state_dict()[name], value), name


@pytest.mark.parametrize("half", HALVES, ids=str)
def test_contrastive_and_kl_terms_are_float32_whatever_comes_in(half: torch.dtype) -> None:
    torch.manual_seed(0)
    text, motion = torch.randn(8, 32).to(half), torch.randn(8, 32).to(half)
    # exp(12) is beyond float16, and 256 + 1 is 256 in bfloat16.
    spread = torch.linspace(-12, 12, 8 * 32).view(8, 32).to(half)
    still = torch.zeros_like(spread)
    nce = info_nce(text.double(), motion.double())
    kl = kl_four((text.double(), spread.double()), (motion.double(), still.double()))
    with autocast(half):
        for value, expected in (
            (info_nce(text, motion), nce),
            (kl_four((text, spread), (motion, still)), kl),
        ):
            assert value.dtype == torch.float32
            assert value.item() == pytest.approx(expected.item(), rel=1e-5)
