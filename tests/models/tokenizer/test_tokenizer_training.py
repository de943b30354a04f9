"""Tokenizer losses against slow references, and the rows of the log."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from plain_training import take_steps
from torch import Tensor, nn

from motionloom.models.tokenizer.base import Recon, TokenizerOutput
from motionloom.models.tokenizer.module import TokenizerModule, reconstruction_loss, velocity_loss
from motionloom.models.tokenizer.single import VqConfig
from motionloom.models.training.stage_module import OptimConfig, StageModule


def slow_error(a: Tensor, b: Tensor, kind: Recon) -> list[float]:
    out = []
    for d in (a - b).flatten().tolist():
        out.append(d * d if kind == "l2" else (0.5 * d * d if abs(d) < 1 else abs(d) - 0.5))
    return out


@pytest.mark.parametrize("kind", ["l2", "smooth_l1"])
def test_losses_equal_a_slow_reference(kind: Recon) -> None:
    torch.manual_seed(0)
    a, b = 2 * torch.randn(3, 6, 2), torch.randn(3, 6, 2)
    length = torch.tensor([6, 2, 1])
    still, moving = [], []
    for i, n in enumerate(length.tolist()):
        still += slow_error(a[i, :n], b[i, :n], kind)
        if n > 1:
            moving += slow_error(a[i, 1:n] - a[i, : n - 1], b[i, 1:n] - b[i, : n - 1], kind)
    recon, velocity = reconstruction_loss(a, b, length, kind), velocity_loss(a, b, length, kind)
    assert recon.item() == pytest.approx(sum(still) / len(still), rel=1e-5)
    assert velocity.item() == pytest.approx(sum(moving) / len(moving), rel=1e-5)
    full = reconstruction_loss(a, b, None, kind)
    assert full.item() == pytest.approx(sum(slow_error(a, b, kind)) / a.numel(), rel=1e-5)
    assert reconstruction_loss(a, b, torch.full((3,), 6), kind).item() == pytest.approx(full.item())


def test_total_is_the_weighted_sum() -> None:
    a, b, penalty = torch.randn(2, 8, 3), torch.randn(2, 8, 3), torch.tensor(4.0)

    def losses(**config: float) -> dict[str, Tensor]:
        net = nn.Module()
        net.config = VqConfig(**config)  # type: ignore[assignment, arg-type]
        net.forward = lambda *_: TokenizerOutput(b, a, penalty, {}, {})
        return TokenizerModule(net, OptimConfig(), seed=0, max_steps=1).losses({"motion": b, "length": None})

    terms = losses(alpha=0.5, velocity_weight=2.0)
    assert set(terms) == {"loss", "recon", "commit", "velocity"}
    torch.testing.assert_close(terms["loss"], terms["recon"] + 2 * terms["velocity"] + 0.5 * penalty)
    plain = losses(alpha=0.02)
    assert set(plain) == {"loss", "recon", "commit"}
    torch.testing.assert_close(plain["loss"], (a - b).square().mean() + 0.08)


class Counting(StageModule):
    """A loss that grows by one a batch."""

    def __init__(self) -> None:
        super().__init__(torch.nn.Linear(1, 1), OptimConfig(), seed=0, max_steps=20)
        self.batches = 0

    def losses(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        self.batches += 1
        return {"loss": self.net(torch.zeros(1)).sum() * 0 + self.batches}


@pytest.mark.parametrize("parts", [1, 2])
def test_a_row_of_the_log_is_the_mean_since_the_last(parts: int) -> None:
    module, rows = Counting(), []
    module.accumulate = parts
    for _ in range(2):
        take_steps(module, [{"length": torch.ones(1)}] * (10 * parts))
        rows.append(float(module.take_row()["train/loss"]))
    assert rows == pytest.approx([5 * parts + 0.5, 15 * parts + 0.5])
