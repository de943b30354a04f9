"""Mixed precision: every stage trains under autocast with finite losses near the float32 ones, and what must
be float32 is.

What learns by averages (codebooks) or exponentiates (InfoNCE, KL, logits) is kept out of the half types:
inputs are made that only float32 gets right.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from plain_training import take_steps
from rank_cases import CASES as CASES_OF_RANKS

from motionloom.models.layers.transformer import Block
from motionloom.models.quantize.base import QuantizerConfig
from motionloom.models.quantize.ema import EmaQuantizer
from motionloom.models.quantize.fsq import FsqQuantizer
from motionloom.models.tma.losses import info_nce, kl_four
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.execution import prepare_module

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


@pytest.mark.parametrize("case", [*CASES, "gpt, residual in bf16"])
def test_a_few_steps_are_near_those_in_float32(case: str) -> None:
    (module, batch), (full, _) = build(case.partition(",")[0]), build(case.partition(",")[0])
    kind = "bf16" if "," in case else "fp32"
    prepare_module(module, TrainConfig(precision="bf16-mixed", residual=kind))  # type: ignore[arg-type]
    types: set[torch.dtype] = set()
    for block in [part for part in module.modules() if isinstance(part, Block)]:
        block.register_forward_hook(lambda _, args, out: types.add(out.dtype))
    before = {name: value.dtype for name, value in module.net.state_dict().items()}
    take_steps(module, [batch] * STEPS, "bf16-mixed")
    take_steps(full, [batch] * STEPS)
    for found, expected in zip(module.figures, full.figures, strict=True):
        assert torch.isfinite(found.values).all(), found.names
        loss = found.names.index("loss")
        assert found.values[loss].item() == pytest.approx(expected.values[loss].item(), rel=0.03)
    assert not case.startswith("gpt") or (HALF in types) == (kind == "bf16"), "others begin in it"
    with torch.autocast("cpu", HALF):
        assert all(value.dtype == torch.float32 for value in module.losses(batch).values())
    for name, value in module.net.state_dict().items():
        assert value.dtype == before[name] and torch.isfinite(value).all(), name
        assert not value.is_floating_point() or value.dtype == torch.float32, name
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
