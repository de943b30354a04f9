"""The streamed order: group of shards by group, other groups each epoch, the same for ever."""

from __future__ import annotations

import pickle

import numpy as np

from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.shards.order import Source


def test_an_epoch_goes_group_by_group_and_epochs_differ() -> None:
    shards = np.repeat(np.arange(12, dtype=np.int32), 10)
    plan = BatchPlan(120, 15, 7, sources=(Source(0, 120, shards=shards, group=3),))
    epochs = []
    for epoch in range(3):
        items = np.concatenate([plan.batch(epoch * 8 + j)[1] for j in range(8)])
        assert sorted(items) == list(range(120))
        groups = [tuple(sorted(set(shards[part]))) for part in items.reshape(4, 30)]
        assert all(len(group) == 3 for group in groups) and len({s for g in groups for s in g}) == 12
        assert any(np.abs(np.diff(shards[part])).max() > 0 for part in items.reshape(4, 30)), (
            "clips are mixed"
        )
        epochs.append((groups, items.tolist()))
    assert epochs[0][0] != epochs[1][0] != epochs[2][0], "other shards meet in a group each epoch"
    late = pickle.loads(pickle.dumps(plan))
    assert late.batch(20)[1].tolist() == plan.batch(20)[1].tolist()


def test_the_streamed_order_is_fixed_for_ever() -> None:
    """A changed order would break every running experiment's resume: these numbers may never change."""
    shards = np.array([0, 0, 0, 1, 1, 2, 2, 2], dtype=np.int32)
    plan = BatchPlan(8, 8, 3, sources=(Source(0, 8, shards=shards, group=2),))
    assert plan.batch(0)[1].tolist() == [1, 0, 2, 3, 4, 6, 7, 5]
    assert plan.batch(1)[1].tolist() == [2, 4, 3, 1, 0, 7, 6, 5]


def test_filtered_clips_and_lengths_keep_the_groups() -> None:
    rng = np.random.default_rng(0)
    shards = np.sort(rng.integers(0, 40, 1000)).astype(np.int32)[rng.random(1000) < 0.7]
    count = len(shards)
    lengths = rng.integers(1, 100, count)
    source = Source(0, count, shards=shards, group=8)
    plain, pooled = (BatchPlan(count, 8, 1, length, (source,)) for length in (None, lengths))
    steps = range(plain.batches_per_epoch)
    assert sorted(np.concatenate([plain.batch(k)[1] for k in steps])) == sorted(
        np.concatenate([pooled.batch(k)[1] for k in steps])
    )
    for start in range(0, len(steps) - 8, 8):
        pool = np.concatenate([pooled.batch(k)[1] for k in range(start, start + 8)])
        assert len(set(shards[pool])) <= 16, "a pool of eight batches lies in two groups"
