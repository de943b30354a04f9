"""Sampling: grammar, lengths, seeds, filters, guidance."""

from __future__ import annotations

import pytest
import torch
from toy_gpt import STREAMS, row_of, toy_gpt

from motionloom.datasets.base.errors import UserError
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.rows import Drawing, filter_logits
from motionloom.models.gpt.sampling import generate, sample_seeds


@pytest.fixture
def gpt() -> InterleavedGPT:
    return toy_gpt(std=0.5)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_alone_equals_in_a_batch(gpt: InterleavedGPT, scale: float) -> None:
    text = torch.randn(7, 6)
    seeds = sample_seeds(3, 7)
    together = generate(gpt, text, seed=3, cfg_scale=scale)
    again = generate(gpt, text, seed=seeds, cfg_scale=scale)
    assert torch.equal(together.groups, again.groups)
    assert len(set(together.groups.tolist())) > 1
    for row in range(7):
        alone = generate(gpt, text[row : row + 1], seed=[seeds[row]], cfg_scale=scale)
        assert row_of(alone, 0) == row_of(together, row)
    chunk = generate(gpt, text[4:], seed=seeds[4:], cfg_scale=scale)
    assert all(row_of(chunk, row) == row_of(together, row + 4) for row in range(3))
    other = generate(gpt, text, seed=4, cfg_scale=scale)
    assert not all(row_of(other, row) == row_of(together, row) for row in range(7))
    assert sample_seeds(3, 2) == seeds[:2]


def test_free_lengths_keep_the_grammar(gpt: InterleavedGPT) -> None:
    gpt.train()
    out = generate(gpt, torch.randn(40, 6), seed=0)
    assert gpt.training
    assert gpt.max_groups == 9
    assert out.groups.min() >= 1
    assert out.groups.max() <= 9
    for stream in STREAMS:
        codes = out.codes[stream.name]
        assert codes.shape == (40, int(out.groups.max()) * stream.per_group)
        assert (codes >= 0).all()
        assert (codes < stream.num_codes).all()
        behind = torch.arange(codes.shape[1])[None] >= stream.per_group * out.groups[:, None]
        assert (codes[behind] == 0).all()


def test_requested_lengths_are_kept(gpt: InterleavedGPT) -> None:
    groups = torch.tensor([1, 9, 4, 9, 2])
    out = generate(gpt, torch.randn(5, 6), groups=groups, seed=1)
    assert torch.equal(out.groups, groups)
    for wrong in ([0, 1, 1, 1, 1], [1, 1, 1, 1, 10]):
        with pytest.raises(UserError, match="1 to 9 groups"):
            generate(gpt, torch.randn(5, 6), groups=torch.tensor(wrong))


def test_cached_sampling_equals_greedy_without_cache(gpt: InterleavedGPT) -> None:
    text = torch.randn(3, 6)
    out = generate(gpt, text, groups=torch.tensor([4, 4, 4]), how=Drawing(0))
    tokens = torch.zeros(3, 12, dtype=torch.int64)
    kinds = gpt.slots.repeat(4).expand(3, -1)
    with torch.no_grad():
        for i in range(12):
            logits = gpt.eval()(tokens, kinds, text)[:, i]
            logits = logits.scatter(1, gpt.ends[kinds[:, i]][:, None], -torch.inf)
            tokens[:, i] = logits.argmax(-1)
    expected = tokens.view(3, 4, 3)
    assert torch.equal(out.codes["body"], expected[:, :, :2].flatten(1))
    assert torch.equal(out.codes["hand"], expected[:, :, 2])


def test_guidance_mixes_the_two_distributions(gpt: InterleavedGPT) -> None:
    text = torch.randn(50, 6)
    groups = torch.full((50,), 1)
    with torch.no_grad():
        gpt.eval()
        kinds, tokens = torch.zeros(50, 1, dtype=torch.int64), torch.zeros(50, 1, dtype=torch.int64)
        on = gpt(tokens, kinds, text)[:, 0, :7]
        off = gpt(tokens, kinds, text, drop_text=torch.ones(50, dtype=torch.bool))[:, 0, :7]
    for scale in (0.0, 1.0, 3.0):
        out = generate(gpt, text, groups=groups, how=Drawing(0), cfg_scale=scale)
        assert torch.equal(out.codes["body"][:, 0], (off + scale * (on - off)).argmax(-1))


def test_draws_follow_the_distribution() -> None:
    logits = torch.tensor([0.5, -torch.inf, 2.0, 1.0, -1.0]).expand(20_000, -1)
    uniform = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000
    for temperature in (1.0, 0.5):
        share = torch.bincount(Drawing(temperature)(logits, uniform), minlength=5) / 20_000
        torch.testing.assert_close(share, (logits[0] / temperature).softmax(-1), rtol=0, atol=1e-4)
    ends = torch.tensor([0.0, 1 - 2**-53], dtype=torch.float64)
    assert Drawing()(torch.tensor([[-torch.inf, 1.0, 1.0, -torch.inf]] * 2), ends).tolist() == [1, 2]


def test_of_a_lost_network_a_code_is_drawn_and_of_no_text_none(gpt: InterleavedGPT) -> None:
    """An index outside of a table ends a GPU's context."""
    uniform = torch.tensor([0.0, 0.9], dtype=torch.float64)
    assert (Drawing()(torch.full((2, 5), torch.nan), uniform) < 5).all()
    assert len(generate(gpt, torch.randn(0, 6), seed=[]).groups) == 0


def test_top_k_and_top_p() -> None:
    logits = torch.tensor([[0.4, 0.1, 0.3, 0.2]]).log()

    def kept(**settings: float) -> set[int]:
        return set(torch.isfinite(filter_logits(logits, **settings))[0].nonzero()[:, 0].tolist())

    assert kept(top_k=2) == {0, 2}
    assert kept(top_k=9) == {0, 1, 2, 3}
    assert kept(top_p=0.3) == {0}
    assert kept(top_p=0.65) == {0, 2}
    assert kept(top_p=0.75) == {0, 2, 3}
    assert kept(top_p=1.0) == {0, 1, 2, 3}
    assert kept(top_k=2, top_p=0.5) == {0}


def test_bad_settings_are_refused(gpt: InterleavedGPT) -> None:
    text = torch.randn(2, 6)
    with pytest.raises(UserError, match="1 seeds"):
        generate(gpt, text, seed=[1])
    with pytest.raises(UserError, match="condition_dropout"):
        generate(toy_gpt(condition_dropout=0.0), text, cfg_scale=2.0)
