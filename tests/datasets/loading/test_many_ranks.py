"""Up to 64 simulated ranks with loader workers over ten thousand shards: index alone, no file is opened."""

from __future__ import annotations

import pickle
import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.order import Source

SHARDS, BATCH = 10_000, 768
WORLDS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


def shards_of(count: int, each: int) -> NDArray[np.int32]:
    """Shards of unequal sizes, about `each` clips in one."""
    sizes = np.random.default_rng(0).integers(each // 2, each + each // 2 + 1, count)
    return np.repeat(np.arange(count, dtype=np.int32), sizes)


@pytest.fixture(autouse=True)
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
    mix = (
        Source(0, half, 2.0, shards[:half], group=16, name="a"),
        Source(half, count - half, 1.0, name="b"),
    )
    return {
        "global": BatchPlan(count, BATCH, seed=3),
        "streamed": BatchPlan(count, BATCH, seed=3, sources=(Source(0, count, shards=shards, group=16),)),
        "by length": BatchPlan(count, BATCH, seed=3, lengths=lengths),
        "mixed": BatchPlan(count, BATCH, seed=3, sources=mix),
    }


ORDERS = ("global", "streamed", "by length", "mixed")


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


@pytest.mark.parametrize("order", ORDERS)
def test_workers_of_many_ranks_see_what_one_process_sees(order: str) -> None:
    """Each worker has a copy of the plan, gets every n-th batch number, and asks for its own rank alone."""
    plan = plans()[order]
    first = plan.batches_per_epoch - 4  # over the border of an epoch
    expected = [plan.batch(k)[1] for k in range(first, first + 8)]
    for world, workers in ((1, 3), (4, 2), (64, 1)):
        found: dict[tuple[int, int], NDArray[np.int64]] = {}
        copies = [pickle.loads(pickle.dumps(plan)) for _ in range(workers)]
        for worker, copy in enumerate(copies):
            for k in range(first + worker, first + 8, workers):
                for rank in range(world):
                    found[k, rank] = copy.local(k, rank, world)[1]
        for number, items in enumerate(expected):
            whole = np.concatenate([found[first + number, rank] for rank in range(world)])
            assert np.array_equal(whole, items)


def test_shards_of_a_group_come_together() -> None:
    """What a streamed order asks of the storage at once: the clips of a batch lie in few groups of shards."""
    shards, plan = shards_of(SHARDS, 8), plans()["streamed"]
    for k in (0, 30, 90):
        assert len(np.unique(shards[plan.batch(k)[1]])) <= 16 * (BATCH // (8 * 16) + 2)
    assert len(np.unique(shards[plans()["global"].batch(0)[1]])) > 600


def test_a_number_of_ranks_that_does_not_divide_is_refused() -> None:
    with pytest.raises(UserError, match="768 clips does not divide over 5 ranks"):
        plans()["global"].local(0, 4, 5)


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
