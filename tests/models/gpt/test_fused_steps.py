"""Steps of few kernels, which half precision is drawn by on a GPU, against `generate` as it is on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import product

import pytest
import torch
from toy_gpt import row_of, toy_gpt

from motionloom.models.gpt import decoding, sampling
from motionloom.models.gpt.rows import Drawing
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


@pytest.mark.parametrize(
    ("backend", "ways"), [("eager", 4), pytest.param("inductor", 1, marks=pytest.mark.slow)]
)
def test_compiled(monkeypatch: pytest.MonkeyPatch, backend: str, ways: int) -> None:
    """More ways of drawing than torch compiles a function in; where it gave up there would be a warning."""
    monkeypatch.setattr(decoding, "_FUSED", {torch.float32})
    monkeypatch.setattr(decoding, "_compiled", cache(partial(torch.compile, fullgraph=True, backend=backend)))
    gpt = toy_gpt(std=0.2)
    hows = Drawing(), Drawing(0), Drawing(1.3, 3), Drawing(0.7, None, 0.9)
    for how, rows, scale in product(hows[:ways], (1, 3), (1.0, 2.5)):
        text = torch.randn(rows, 6)
        want = generate(gpt, text, how=how, cfg_scale=scale)
        with monkeypatch.context() as fixed:
            fixed.setattr(sampling, "_FIXED", {"cpu"})
            found = generate(gpt, text, how=how, cfg_scale=scale)
        assert [row_of(found, row) for row in range(rows)] == [row_of(want, row) for row in range(rows)]
        assert decoding._KEPT[gpt].advance is decoding.advance_fused


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
