"""The batch plan: pure, complete, and the same for every number of ranks, also of ten thousand shards."""

from __future__ import annotations

import pickle
import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from motionloom.datasets.base.randomness import permutation, uniform
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.order import Source


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 200), st.integers(1, 40), st.integers(0, 2**31), st.integers(0, 500))
def test_an_epoch_is_a_permutation_cut_into_whole_batches(
    items: int, batch: int, seed: int, start: int
) -> None:
    plan = BatchPlan(items, batch, seed)
    per_epoch = plan.batches_per_epoch
    assert per_epoch == max(1, items // batch)
    first = start // per_epoch * per_epoch
    turns, parts = zip(*[plan.batch(first + j) for j in range(per_epoch)], strict=True)
    assert set(np.concatenate(turns)) == {first // per_epoch}
    drawn = np.concatenate(parts)
    if items >= batch:
        assert len(np.unique(drawn)) == len(drawn) == per_epoch * batch
    else:
        assert len(drawn) == batch and set(drawn) == set(range(items))
    assert drawn.min() >= 0 and drawn.max() < items


def test_any_order_of_questions_gives_the_same_answers() -> None:
    forward = BatchPlan(50, 7, seed=1)
    want = [forward.batch(k)[1] for k in range(40)]
    asked = pickle.loads(pickle.dumps(forward))
    for k in np.random.default_rng(0).permutation(40):
        np.testing.assert_array_equal(asked.batch(int(k))[1], want[k])
    assert not np.array_equal(want[0], BatchPlan(50, 7, seed=2).batch(0)[1])
    assert not np.array_equal(want[0], want[7]), "epochs must differ"


def test_the_order_is_fixed_for_ever() -> None:
    """A changed order would break every running experiment's resume: these numbers may never change."""
    assert permutation(10, 3, 4).tolist() == [3, 2, 6, 1, 4, 9, 5, 7, 8, 0]
    assert uniform(1, 2, np.arange(3)).tolist() == [
        0.9006109088931584,
        0.05081380623834486,
        0.545963299984951,
    ]


def test_uniform_is_uniform_and_depends_on_every_counter() -> None:
    draws = uniform(5, np.arange(1000)[:, None], np.arange(50)[None])
    assert draws.shape == (1000, 50) and draws.min() >= 0 and draws.max() < 1
    counts = np.histogram(draws, bins=20, range=(0, 1))[0]
    assert np.abs(counts - 2500).max() < 5 * np.sqrt(2500)
    assert abs(np.corrcoef(draws[:, 0], draws[:, 1])[0, 1]) < 0.12
    assert uniform(1, 2) != uniform(2, 1)
    assert uniform(3, 4, 5) == uniform(3, np.array([4]), np.array([[5]]))[0, 0]


def test_mistakes_are_named() -> None:
    with pytest.raises(UserError, match="does not divide over 5 ranks"):
        BatchPlan(100, 12, 0).local(0, 0, 5)
    with pytest.raises(UserError, match="no items"):
        BatchPlan(0, 4, 0)
    with pytest.raises(UserError, match="at least one item"):
        BatchPlan(5, 0, 0)


def test_lengths_lessen_padding_and_keep_the_epoch() -> None:
    lengths = np.random.default_rng(0).integers(1, 100, size=1003)
    plain, sorted_plan = BatchPlan(1003, 16, 5), BatchPlan(1003, 16, 5, lengths)

    def padding(plan: BatchPlan) -> float:
        batches = [lengths[plan.batch(k)[1]] for k in range(plan.batches_per_epoch)]
        return sum(float((b.max() - b).sum()) for b in batches) / sum(float(b.sum()) for b in batches)

    assert padding(sorted_plan) < 0.35 * padding(plain)
    for epoch in range(2):
        first = epoch * plain.batches_per_epoch
        steps = range(first, first + plain.batches_per_epoch)
        seen = [np.concatenate([plan.batch(k)[1] for k in steps]) for plan in (plain, sorted_plan)]
        assert np.array_equal(np.sort(seen[0]), np.sort(seen[1]))
    means = [lengths[sorted_plan.batch(k)[1]].mean() for k in range(sorted_plan.batches_per_epoch)]
    assert not np.all(np.diff(means) >= 0), "batches come in random order, not from short to long"
    assert not np.array_equal(sorted_plan.batch(0)[1], sorted_plan.batch(plain.batches_per_epoch)[1])


def test_lengths_with_fewer_items_than_a_batch() -> None:
    assert np.array_equal(np.sort(BatchPlan(3, 4, 0, np.array([5, 1, 9])).batch(0)[1][:3]), [0, 1, 2])


SHARDS, BATCH = 10_000, 768
WORLDS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


def shards_of(count: int, each: int) -> NDArray[np.int32]:
    """Shards of unequal sizes, about `each` clips in one."""
    sizes = np.random.default_rng(0).integers(each // 2, each + each // 2 + 1, count)
    return np.repeat(np.arange(count, dtype=np.int32), sizes)


@pytest.fixture
def no_files(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Opening a file is an error."""

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError(f"a file was opened: {arguments}")

    with monkeypatch.context() as patched:
        patched.setattr("builtins.open", refuse)
        patched.setattr("io.open", refuse)
        yield


def plans() -> dict[str, BatchPlan]:
    """One for each kind of order, of about 80 thousand clips in ten thousand shards."""
    shards = shards_of(SHARDS, 8)
    count = len(shards)
    half = count // 2
    lengths = np.random.default_rng(1).integers(40, 200, count)
    mix = (Source(0, half, 2.0, shards[:half], group=16, name="a"), Source(half, count - half, 1.0, name="b"))
    return {
        "global": BatchPlan(count, BATCH, seed=3),
        "streamed": BatchPlan(count, BATCH, seed=3, sources=(Source(0, count, shards=shards, group=16),)),
        "by length": BatchPlan(count, BATCH, seed=3, lengths=lengths),
        "mixed": BatchPlan(count, BATCH, seed=3, sources=mix),
    }


ORDERS = ("global", "streamed", "by length", "mixed")


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize("order", ORDERS)
def test_ranks_share_every_global_batch_out_alike(order: str) -> None:
    """Two epochs: equal counts, nothing twice in a batch or (of one data set) an epoch, the same for any
    number of ranks.
    """
    plan = plans()[order]
    for epoch in range(2):
        seen = []
        for k in range(epoch * plan.batches_per_epoch, (epoch + 1) * plan.batches_per_epoch):
            turns, items = plan.batch(k)
            seen.append(items)
            for world in WORLDS if k % 37 == 0 else (64,):
                parts = [plan.local(k, rank, world) for rank in range(world)]
                assert {len(part) for _, part in parts} == {BATCH // world}
                assert np.array_equal(np.concatenate([part for _, part in parts]), items)
                assert np.array_equal(np.concatenate([turn for turn, _ in parts]), turns)
        drawn = np.concatenate(seen)
        assert len(drawn) == plan.num_items // BATCH * BATCH
        if order != "mixed":  # a lighter data set's clips come again before all of the other's have come
            assert len(np.unique(drawn)) == len(drawn)
            assert plan.num_items - len(drawn) < BATCH, "an epoch leaves out less than a batch"


@pytest.mark.usefixtures("no_files")
def test_a_million_samples_fit_into_little_memory() -> None:
    """A streamed epoch's order and a batch of it (32 MiB here), and the step to the next epoch."""
    shards = shards_of(SHARDS, 100)
    sources = (Source(0, len(shards), shards=shards, group=16),)
    lengths = np.random.default_rng(1).integers(40, 200, len(shards))
    tracemalloc.start()
    try:
        plan = BatchPlan(len(shards), 1024, seed=0, lengths=lengths, sources=sources)
        plan.local(0, 63, 64)
        plan.local(plan.batches_per_epoch, 0, 64)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(shards) > 990_000 and peak < 200 * 2**20
