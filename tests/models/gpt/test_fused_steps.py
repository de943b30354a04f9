"""Steps of few kernels, which half precision is drawn by on a GPU, against `generate` as it is on a CPU."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from toy_gpt import row_of, toy_gpt

from motionloom.models.gpt import decoding, sampling
from motionloom.models.gpt.sampling import generate


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of fixed shapes on this CPU, fused by nobody."""
    monkeypatch.setattr(decoding, "_compiled", lambda function: function)
    monkeypatch.setattr(decoding, "_FUSED", {torch.float32, torch.bfloat16})


@pytest.mark.parametrize("few", [0, 99])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_tokens_of_float32(plain: None, monkeypatch: pytest.MonkeyPatch, few: int, scale: float) -> None:
    """Rows that end leave the others, in either kind of step."""
    gpt = toy_gpt(std=0.2, block_size=100)
    torch.nn.init.constant_(gpt.get_parameter("heads.0.bias")[-1], 1.5)  # End is no rare token
    text = torch.randn(12, 6)
    sizes: list[int] = []
    record = decoding.FixedSteps.record

    def recording(self: decoding.FixedSteps, step: Callable[[], None]) -> Callable[[], None]:
        sizes.append(len(self.rows.tokens))
        return record(self, step)

    monkeypatch.setattr(decoding, "FEW", few)
    monkeypatch.setattr(decoding.FixedSteps, "record", recording)
    rows = [generate(gpt, text[row : row + 1], seed=[row], cfg_scale=scale) for row in range(12)]
    monkeypatch.setattr(sampling, "_FIXED", {"cpu"})
    found = generate(gpt, text, seed=range(12), cfg_scale=scale)
    for row in range(12):
        assert row_of(found, row) == row_of(rows[row], 0)
    assert sizes[0] == 12 and sizes[-1] < 12, "rows have left"


def test_distribution_of_bfloat16(plain: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """10,000 draws of pairs of tokens by other seeds, by a chi-square test of two samples."""
    gpt = toy_gpt(std=0.2)
    text = torch.randn(1, 6).expand(10_000, -1)
    one = torch.ones(10_000, dtype=torch.int64)

    def pairs(first: int) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            codes = generate(gpt, text, groups=one, seed=range(first, first + 10_000)).codes["body"]
        return torch.bincount(codes[:, 0] * 7 + codes[:, 1], minlength=49).double()

    before = pairs(0)
    monkeypatch.setattr(sampling, "_FIXED", {"cpu"})
    for few in (0, 10_000):
        monkeypatch.setattr(decoding, "FEW", few)
        found = pairs(10_000 + few)
        enough = before + found >= 10
        square = ((before - found)[enough] ** 2 / (before + found)[enough]).sum()
        freedom = int(enough.sum()) - 1
        assert freedom > 10 and square < freedom + 4 * (2 * freedom) ** 0.5
        assert not torch.equal(before, found)
