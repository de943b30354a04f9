"""The batch plan: pure, complete, the same for every number of ranks, of mixes and of ten thousand shards."""

from __future__ import annotations

import pickle
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rank_shares import require_shares
from text_samples import OneToken, caption_batches

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.randomness import permutation, uniform
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.condition_batches import EvalBatches
from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.loading.order import shares
from motionloom.datasets.loading.plan import BatchPlan, Share
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.clips import Source
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.text.build import build_with_encoder


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


def test_the_order_is_fixed_for_ever() -> None:
    """A changed order would break every running experiment's resume: these numbers may never change."""
    assert permutation(10, 3, 4).tolist() == [3, 2, 6, 1, 4, 9, 5, 7, 8, 0]
    assert uniform(1, 2, np.arange(3)).tolist() == [
        0.9006109088931584,
        0.05081380623834486,
        0.545963299984951,
    ]
    plan = BatchPlan(6, 6, 3, sources=(Source(0, 4, 1.0), Source(4, 2, 2.0)))
    turns, items = plan.batch(1)
    assert items.tolist() == [4, 0, 5, 5, 1, 4] and turns.tolist() == [2, 0, 2, 3, 0, 3]


def test_uniform_is_uniform_and_depends_on_every_counter() -> None:
    draws = uniform(5, np.arange(1000)[:, None], np.arange(50)[None])
    assert draws.shape == (1000, 50) and draws.min() >= 0 and draws.max() < 1
    counts = np.histogram(draws, bins=20, range=(0, 1))[0]
    assert np.abs(counts - 2500).max() < 5 * np.sqrt(2500)
    assert abs(np.corrcoef(draws[:, 0], draws[:, 1])[0, 1]) < 0.12
    assert uniform(1, 2) != uniform(2, 1)
    assert uniform(3, 4, 5) == uniform(3, np.array([4]), np.array([[5]]))[0, 0]


def test_mistakes_in_a_plan_are_named() -> None:
    with pytest.raises(UserError, match="5 ranks"):
        BatchPlan(100, 12, 0).local(0, Share(0, 5))
    with pytest.raises(UserError, match="empty"):
        BatchPlan(0, 4, 0)
    with pytest.raises(UserError, match="not 0"):
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
                parts = [plan.local(k, Share(rank, world)) for rank in range(world)]
                assert {len(part) for _, part in parts} == {BATCH // world}
                assert np.array_equal(np.concatenate([part for _, part in parts]), items)
                assert np.array_equal(np.concatenate([turn for turn, _ in parts]), turns)
            # A step in parts reads the same clips: else another `accumulate` would go on elsewhere.
            cut = [plan.local(2 * k + part, Share(rank, 2, 2)) for part in range(2) for rank in range(2)]
            assert np.array_equal(np.concatenate([part for _, part in cut]), items)
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
        plan.local(0, Share(63, 64))
        plan.local(plan.batches_per_epoch, Share(0, 64))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(shards) > 990_000 and peak < 200 * 2**20


@pytest.fixture(scope="module")
def roots(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    roots = tmp_path_factory.mktemp("big"), tmp_path_factory.mktemp("small")
    made.write(roots[0], count=100)
    made.write(roots[1], count=20)
    return roots


def mixed(
    roots: tuple[Path, Path], weights: tuple[float, float] = (1.0, 3.0), **reading: object
) -> MixedDataset:
    opened = [ShardDataset.open(root, "train", reading=Reading.parse(reading, "test")) for root in roots]
    return MixedDataset(list(zip(opened, weights, strict=True)))


@pytest.fixture(scope="module")
def mix(roots: tuple[Path, Path]) -> MixedDataset:
    return mixed(roots)


def test_clips_are_numbered_through(mix: MixedDataset, roots: tuple[Path, Path]) -> None:
    big, small = (ShardDataset.open(root, "train") for root in roots)
    assert len(mix) == 72 == len(mix.ids) and mix.where == f"{roots[0]} + {roots[1]}"
    for i, (dataset, own) in {0: (big, 0), 59: (big, 59), 60: (small, 0), 71: (small, 11)}.items():
        np.testing.assert_array_equal(mix.motion(i), dataset.motion(own))
        assert mix.texts(i) == dataset.texts(own) and mix.face_texts(i) == dataset.face_texts(own)
        assert mix.meta(i) == dataset.meta(own) and mix.ids[i] == dataset.ids[own]
        assert np.array_equal(mix.array(i, "audio.npy"), dataset.array(own, "audio.npy"))
        assert mix.frames[i] == dataset.frames[own] and (mix.wav(i) is None) == (dataset.wav(own) is None)
        assert mix.has("audio.npy")[i] == dataset.has("audio.npy")[own]
    with pytest.raises(IndexError):
        mix.motion(72)
    copy = pickle.loads(pickle.dumps(mix))
    np.testing.assert_array_equal(copy.motion(65), mix.motion(65))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 60), st.integers(1, 9)), min_size=1, max_size=5),
    st.integers(1, 16),
    st.integers(0, 50),
)
def test_any_mix_is_exact_and_asked_in_any_order(parts: list[tuple[int, int]], batch: int, k: int) -> None:
    first, sources = 0, []
    for count, weight in parts:
        sources.append(Source(first, count, float(weight)))
        first += count
    used = max(1, first // batch) * batch
    total = sum(weight for _, weight in parts)
    wanted = [used * weight / total for _, weight in parts]
    if min(wanted) < 1:
        return
    got = shares(sources, used)
    assert sum(got) == used and all(abs(g - w) < 1 for g, w in zip(got, wanted, strict=True))
    plan = BatchPlan(first, batch, 1, sources=sources)
    other = pickle.loads(pickle.dumps(plan))
    other.batch(k + 7)
    assert all(np.array_equal(a, b) for a, b in zip(plan.batch(k), other.batch(k), strict=True))
    epoch = k // plan.batches_per_epoch * plan.batches_per_epoch
    items = np.concatenate([plan.batch(epoch + j)[1] for j in range(plan.batches_per_epoch)])
    edges = [source.first for source in sources] + [first]
    assert np.histogram(items, edges)[0].tolist() == got


@pytest.mark.parametrize("order", ["global", "streamed"])
def test_batches_are_the_same_for_any_number_of_ranks(order: str, roots: tuple[Path, Path]) -> None:
    data = mixed(roots, order=order, shards_per_group=2)
    stats = compute(data)

    def windows(share: Share) -> WindowBatches:
        return WindowBatches(data, stats, window=16, batch_size=24, seed=1, share=share)

    require_shares(windows)
    evaluated = EvalBatches(data, stats, batch_size=16, max_frames=40)
    seen = [i for k in range(len(evaluated)) for i in evaluated[k]["index"].tolist()]
    assert seen == list(range(72)), "evaluation does not weigh"


def test_a_clip_drawn_again_gives_another_window(mix: MixedDataset) -> None:
    batches = WindowBatches(mix, compute(mix), window=4, batch_size=72, seed=1)
    turns, clips = batches.plan.batch(0)
    motion = batches[0]["motion"]
    again = {}
    for row, (turn, clip) in enumerate(zip(turns.tolist(), clips.tolist(), strict=True)):
        again.setdefault(clip, {})[turn] = motion[row]
    several = [list(rows.values()) for rows in again.values() if len(rows) > 2]
    assert several and all(not torch.equal(rows[0], rows[1]) for rows in several)


def test_caption_batches_draw_only_from_data_sets_with_captions(mix: MixedDataset, tmp_path: Path) -> None:
    captions = [c.text for i in range(len(mix)) for c in mix.texts(i)]
    text = build_with_encoder(tmp_path, captions, OneToken(), progress=False)
    batches = caption_batches(mix, compute(mix), text, batch_size=8, max_frames=40, min_frames=30, seed=2)
    usable = set(np.flatnonzero(mix.frames >= 30).tolist())
    seen = Counter(int(i >= 60) for k in range(8) for i in batches[k]["index"].tolist())
    assert set(batches[0]["index"].tolist()) <= usable and seen[1] == 48 and seen[0] == 16
    long = caption_batches(mix, compute(mix), text, batch_size=8, max_frames=90, min_frames=60, seed=2)
    assert long[0]["index"].max() < 60


def test_statistics_are_weighted_and_natural_weights_change_nothing(roots: tuple[Path, Path]) -> None:
    parts = [ShardDataset.open(root, "train") for root in roots]
    rows = [[np.asarray(d.motion(i), np.float64) for i in range(len(d))] for d in parts]
    every = np.concatenate([clip for part in rows for clip in part])
    natural = compute(mixed(roots, (60.0, 12.0)))
    np.testing.assert_allclose(natural.mean, every.mean(0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(natural.std, every.std(0), rtol=1e-6)
    assert natural.frames == len(every)
    big, small = (np.concatenate(part) for part in rows)
    weighted = compute(mixed(roots, (1.0, 5.0)))  # the 12 clips stand for five times the 60: 25 copies
    want = np.concatenate([big, *[small] * 25])
    np.testing.assert_allclose(weighted.mean, want.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(weighted.std, want.std(0), rtol=1e-6)


def test_mistakes_in_a_mix_are_named(mix: MixedDataset, roots: tuple[Path, Path]) -> None:
    big, small = (ShardDataset.open(root, "train") for root in roots)
    with pytest.raises(UserError, match="weight"):
        MixedDataset([(big, 0.0)])
    with pytest.raises(UserError, match="at least one"):
        MixedDataset([])
    small.layout = MotionLayout.named("body133", fps=30.0)
    with pytest.raises(UserError, match=rf"{roots[1]}: .*body133 .*30 fps.*20"):
        MixedDataset([(big, 1.0), (small, 1.0)])
    with pytest.raises(UserError, match="mix"):
        MixedDataset([(mix, 1.0), (big, 1.0)]).sources()
    with pytest.raises(UserError, match=rf"{roots[0]}: weight 0.001"):
        stats = FeatureStats(np.zeros(133, np.float32), np.ones(133, np.float32), mix.layout)
        WindowBatches(mixed(roots, (0.001, 1.0)), stats, window=8, batch_size=8)
