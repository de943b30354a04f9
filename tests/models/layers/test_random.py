"""Draws by sample: what they depend on, against a slow version in Python's integers, and how they spread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import stats
from torch import Tensor

from motionloom.models.diffusion.network import DiffusionConfig
from motionloom.models.layers import random
from motionloom.models.layers.transformer import Transformer

M = 2**64 - 1
STACK = DiffusionConfig(dim=8, heads=2, ff=16, dropout=0.3)
GAMMA = 0x9E3779B97F4A7C15


def mix(x: int) -> int:
    """splitmix64, as its authors publish it."""
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & M
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & M
    return x ^ (x >> 31)


def word(seed: int, step: int, turn: int, site: int, sample: int, row: int | None, place: int) -> int:
    """One word, from the docstring of `draws`."""
    key = seed & M
    for number in (step + 1, turn + 1):
        key = mix((key + number * GAMMA) & M)
    key = mix((key + (sample + 1) * GAMMA) & M)
    key = mix((key + site * GAMMA) & M)
    if row is not None:
        key = mix((key + row * GAMMA) & M)
    return mix((key + (place + 1) * GAMMA) & M)


def half(word: int, which: int) -> int:
    """Lower or upper 32 bits, as int32."""
    bits = (word >> 32 * which) & 0xFFFFFFFF
    return bits - 2**32 if bits >= 2**31 else bits


@pytest.fixture(autouse=True)
def by_rank_afterwards() -> Iterator[None]:
    yield
    random.end()


def test_the_finaliser_is_splitmix64s() -> None:
    """The published generator's first three words for seed 1234567."""
    words = [mix((1234567 + n * GAMMA) & M) for n in (1, 2, 3)]
    assert words == [6457827717110365317, 3203168211198807973, 9817491932198370423]
    given = torch.tensor([1234567, -1, 2**63 - 1, -(2**63)])
    assert [int(x) & M for x in random._mix(given)] == [mix(int(x) & M) for x in given]


def test_every_draw_is_the_hash_of_its_place() -> None:
    samples = torch.tensor([5, 0, 2**20])
    with random.keyed(2**63 + 11, 7, samples, turn=1):
        rows = random._bits((3,))
        tables = random._bits((3, 2, 5))
        several = random._bits((6, 3, 2, 4))
    for b, sample in enumerate(samples.tolist()):
        key = (2**63 + 11, 7, 1)
        assert int(rows[b]) == half(word(*key, 1, sample, None, 0), 0)
        for i in range(2):
            for j in range(5):
                place = (i << random.POSITION_BITS) + j // 2
                assert int(tables[b, i, j]) == half(word(*key, 2, sample, None, place), j % 2)
        place = (((2 << random.POSITION_BITS) + 1) << random.POSITION_BITS) + 1
        assert int(several[2 * b + 1, 2, 1, 3]) == half(word(*key, 3, sample, 1, place), 1)


Draw = Callable[[int], Any]

DRAWS: dict[str, Draw] = {
    "uniform": lambda n: random.uniform(n, 3, 5),
    "of a row": lambda n: random.uniform(n),
    "uniforms": lambda n: torch.stack(random.uniforms(3, n), dim=1),
    "normal": lambda n: random.normal(n, 7),
    "normal of a row": lambda n: random.normal(n),
    "normal, like": lambda n: random.normal_like(torch.zeros(n, 4, 3, dtype=torch.float64)),
    "integers": lambda n: random.integers(1000, n),
    "seeds": lambda n: torch.tensor(random.seeds(2 * n)).view(n, 2),
    "dropout": lambda n: random.dropout(torch.ones(n, 6, 9), 0.3),
    "gumbel": lambda n: random.gumbel_softmax(torch.zeros(n, 3, 8), 0.7),
}


@pytest.mark.parametrize("name", list(DRAWS))
def test_any_share_of_the_samples_draws_what_the_whole_does(name: str) -> None:
    """Also behind other draws; other steps, seeds and turns draw otherwise."""

    def drawn(samples: Tensor, seed: int = 1, step: int = 4, turn: int = 0) -> Tensor:
        with random.keyed(seed, step, samples, turn):
            random.uniform(len(samples))
            out: Tensor = DRAWS[name](len(samples))
        return out

    whole = drawn(torch.arange(24))
    for first, end in ((0, 1), (5, 13), (12, 24)):
        assert torch.equal(drawn(torch.arange(first, end)), whole[first:end])
    assert all(not torch.equal(whole, drawn(torch.arange(24), **other)) for other in
               ({"seed": 2}, {"step": 5}, {"turn": 1}))  # fmt: skip
    assert len(whole.flatten(1).unique(dim=0)) > 18 if whole[0].numel() > 2 else whole.unique().numel() > 18


def test_padding_moves_no_draw() -> None:
    samples = torch.arange(4)

    def drawn(length: int) -> Tensor:
        with random.keyed(0, 0, samples):
            return random.uniform(4, length, 3)

    assert torch.equal(drawn(9)[:, :5], drawn(5))
    with random.keyed(0, 0, samples):
        plain = random.dropout(torch.ones(4, 6, 3), 0.5)
    for positions in ([0, 1, 4, 5], [3, 2]):
        with random.keyed(0, 0, samples), random.positions(torch.tensor(positions)):
            found = random.dropout(torch.ones(4, len(positions), 3), 0.5)
        assert torch.equal(found, plain[:, positions])
    with random.keyed(0, 0, samples):
        random.uniform(4)
        with random.positions(torch.arange(6)):
            wide = random.dropout(torch.ones(4, 2, 6, 6), 0.5, along=(2, 3))
    with random.keyed(0, 0, samples):
        random.uniform(4)
        with random.positions(torch.tensor([1, 5])):
            narrow = random.dropout(torch.ones(4, 2, 2, 2), 0.5, along=(2, 3))
    assert torch.equal(narrow, wide[:, :, [1, 5]][..., [1, 5]])


def test_torch_draws_outside_a_step() -> None:
    x = torch.randn(4, 3, 8)
    pairs: list[tuple[Callable[[], Any], Callable[[], Any]]] = [
        (lambda: random.uniform(4, 3), lambda: torch.rand(4, 3)),
        (lambda: torch.stack(random.uniforms(3, 4)), lambda: torch.rand(3, 4)),
        (lambda: random.normal(4, 3), lambda: torch.randn(4, 3)),
        (lambda: random.normal_like(x), lambda: torch.randn_like(x)),
        (lambda: random.integers(9, 4), lambda: torch.randint(0, 9, (4,))),
        (lambda: torch.tensor(random.seeds(4)), lambda: torch.randint(2**62, (4,))),
        (lambda: random.Dropout(0.4)(x), lambda: torch.nn.Dropout(0.4)(x)),
        (lambda: random.gumbel_softmax(x, 0.5), lambda: F.gumbel_softmax(x, tau=0.5, hard=True)),
        (lambda: random.attention(x[None], x[None], x[None], None, True, 0.2),
         lambda: F.scaled_dot_product_attention(x[None], x[None], x[None], is_causal=True, dropout_p=0.2)),
    ]  # fmt: skip
    for ours, theirs in pairs:
        torch.manual_seed(5)
        first = ours()
        torch.manual_seed(5)
        assert torch.equal(first, theirs())
    assert not list(random.Dropout(0.1).state_dict())
    with random.keyed(0, 0, torch.arange(4)):
        assert torch.equal(random.Dropout(0.4).eval()(x), x)
        assert random.Dropout(0.0)(x) is x or torch.equal(random.Dropout(0.0)(x), x)


def many(draw: Callable[[], Tensor]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Draws of 2000 samples in one step."""
    with random.keyed(3, 12345, torch.arange(2000)):
        return draw().double().numpy()


def test_uniform_and_independent() -> None:
    """Kolmogorov and Smirnov; neighbours along each dimension, and of other steps and sites.

    Seeds are fixed, so each of these either holds for ever or never does.
    """
    u = many(lambda: random.uniform(2000, 10, 15))
    assert u.min() >= 0 and u.max() < 1
    assert stats.kstest(u.ravel(), "uniform").pvalue > 0.01
    with random.keyed(3, 12346, torch.arange(2000)):
        step, site = (random.uniform(2000, 10, 15).double().numpy() for _ in range(2))
    pairs = [(u[1:], u[:-1]), (u[:, 1:], u[:, :-1]), (u[..., 1:], u[..., :-1]), (u, step), (step, site)]
    for one, other in pairs:
        table = np.histogram2d(one.ravel(), other.ravel(), bins=16, range=[[0, 1], [0, 1]])[0]
        assert stats.chisquare(table.ravel()).pvalue > 0.01


def test_normal_is_normal() -> None:
    z = many(lambda: random.normal(2000, 10, 15))
    assert stats.kstest(z.ravel(), "norm").pvalue > 0.01
    assert stats.pearsonr(z[..., 1:14:2].ravel(), z[..., 0:13:2].ravel()).pvalue > 0.01, "of one word"
    assert stats.pearsonr(z[..., 1:14:2].ravel() ** 2, z[..., 0:13:2].ravel() ** 2).pvalue > 0.01


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9])
def test_dropout_keeps_the_mean(rate: float) -> None:
    x = many(lambda: random.dropout(torch.ones(2000, 10, 15), rate))
    assert set(np.unique(x)) == {0.0, np.float32(1 / (1 - rate))}
    assert stats.binomtest(int((x == 0).sum()), x.size, rate).pvalue > 0.01


def test_gumbel_draws_by_the_logits() -> None:
    logits = torch.tensor([0.0, 1.0, -1.0, 0.5]).expand(2000, 10, 4).clone().requires_grad_()
    with random.keyed(3, 0, torch.arange(2000)):
        hard = random.gumbel_softmax(logits, 0.7)
    assert torch.equal(hard.sum(-1), torch.ones(2000, 10)) and set(hard.unique().tolist()) == {0.0, 1.0}
    counts = hard.sum((0, 1)).detach().numpy()
    assert stats.chisquare(counts, counts.sum() * logits[0, 0].softmax(-1).detach().numpy()).pvalue > 0.01
    hard[..., 0].sum().backward()
    assert logits.grad is not None and logits.grad.abs().sum() > 0


@pytest.mark.parametrize("masked", [False, True])
def test_attention_without_dropout_is_torchs(masked: bool) -> None:
    """With a rate too small to drop anything here; a row that sees nothing gives 0."""
    q, k, v = torch.randn(3, 4, 2, 6, 8, dtype=torch.float64)
    mask = torch.rand(4, 1, 6, 6) > 0.4 if masked else None
    if mask is not None:
        mask[0, 0, 2] = False
    with random.keyed(0, 0, torch.arange(4)):
        ours = random.attention(q, k, v, mask, not masked, 1e-9)
    theirs = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=not masked)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-8)


def test_checkpointed_activations_draw_again_what_they_drew() -> None:
    torch.manual_seed(0)
    stack = Transformer(STACK, 2).double()
    x = torch.randn(3, 5, 8, dtype=torch.float64)
    grads = []
    for stack.checkpointed in (False, True):
        stack.zero_grad()
        random.begin(1, 2, torch.arange(3))
        out = stack(x, torch.ones(3, 5, dtype=torch.bool))
        random.uniform(3)  # of a later site
        out.square().sum().backward()
        grads.append([p.grad.clone() for p in stack.parameters() if p.grad is not None])
    for one, two in zip(*grads, strict=True):
        assert torch.equal(one, two)


@pytest.mark.slow
def test_compiled_draws_are_the_same_and_one_graph() -> None:
    torch.compiler.reset()
    stack = Transformer(STACK, 1).double()
    x = torch.randn(4, 5, 8, dtype=torch.float64)

    def run(x: Tensor) -> tuple[Tensor, Tensor]:
        return stack(x), random.normal(len(x), 3)

    compiled = torch.compile(run, fullgraph=True, backend="aot_eager")
    torch._dynamo.utils.counters.clear()
    for step in range(3):
        with random.keyed(1, step, torch.arange(4)):
            found = compiled(x)
        with random.keyed(1, step, torch.arange(4)):
            expected = run(x)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1, "compiled anew for every step"


def test_a_draw_for_other_rows_is_an_error() -> None:
    with random.keyed(0, 0, torch.arange(4)), pytest.raises(ValueError, match=r"size \[5, 2\]"):
        random.uniform(5, 2)
