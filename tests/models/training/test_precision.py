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
HALF = torch.bfloat16
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


def train(case: str, *, half: bool) -> tuple[StageModule, list[dict[str, Tensor]]]:
    """A few steps on one batch, as Lightning makes them: forward and losses under autocast alone."""
    module, batch = build(case)
    optimizer = module.configure_optimizers()[0]["optimizer"]
    found = []
    for step in range(STEPS):
        torch.manual_seed(step)
        with torch.autocast("cpu", HALF, enabled=half):
            values = module.losses(batch)
        optimizer.zero_grad()
        values["loss"].backward()
        optimizer.step()
        found.append({name: value.detach() for name, value in values.items()})
    return module, found


@pytest.mark.parametrize("case", CASES)
def test_a_few_steps_are_near_those_in_float32(case: str) -> None:
    before = {name: (v.dtype, v.is_floating_point()) for name, v in build(case)[0].net.state_dict().items()}
    module, found = train(case, half=True)
    _, expected = train(case, half=False)
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


def test_codes_are_assigned_in_float32() -> None:
    """Codes four thousandths apart, far from zero: bfloat16 would call them the same."""
    quantizer = EmaQuantizer(QuantizerConfig(num_codes=16, dim=4)).eval()
    quantizer.codebook.copy_(1 + torch.arange(16)[:, None] * 4e-3)
    z = quantizer.codebook[None] + 2e-4
    fsq = FsqQuantizer(4, (5, 4))
    wide = torch.randn(1, 200, 4) * 3
    plain = fsq(wide).codes
    with torch.autocast("cpu", HALF):
        out = quantizer(z)
        assert torch.equal(out.codes[0], torch.arange(16))
        assert out.quantized.dtype == out.penalty.dtype == torch.float32
        assert torch.equal(fsq(wide).codes, plain)
        assert quantizer.vectors(out.codes).dtype == torch.float32


def test_contrastive_and_kl_terms_are_float32_whatever_comes_in() -> None:
    torch.manual_seed(0)
    text, motion = torch.randn(8, 32).to(HALF), torch.randn(8, 32).to(HALF)
    # 256 + 1 is 256 in bfloat16.
    spread = torch.linspace(-12, 12, 8 * 32).view(8, 32).to(HALF)
    still = torch.zeros_like(spread)
    nce = info_nce(text.double(), motion.double())
    kl = kl_four((text.double(), spread.double()), (motion.double(), still.double()))
    with torch.autocast("cpu", HALF):
        for value, expected in (
            (info_nce(text, motion), nce),
            (kl_four((text, spread), (motion, still)), kl),
        ):
            assert value.dtype == torch.float32
            assert value.item() == pytest.approx(expected.item(), rel=1e-5)
