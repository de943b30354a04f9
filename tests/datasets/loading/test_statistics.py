"""Feature statistics: one pass equals two, merges in any grouping, HumanML3D's groups, saved with layout."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import STD_FLOOR, FeatureStats, Moments, compute, from_moments
from motionloom.datasets.motion.layout import ROOT, MotionLayout
from motionloom.datasets.shards.reader import ShardDataset


@pytest.fixture(scope="module")
def train(root: Path) -> ShardDataset:
    return ShardDataset.open(root, "train")


def test_one_pass_equals_two(train: ShardDataset) -> None:
    rows = np.concatenate([train.motion(i) for i in range(len(train))]).astype(np.float64)
    stats = compute(train)
    np.testing.assert_allclose(stats.mean, rows.mean(axis=0), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(stats.std, rows.std(axis=0), rtol=1e-6)
    assert stats.frames == len(rows) and stats.layout == train.layout


def test_the_root_counts_as_much_as_is_said(train: ShardDataset) -> None:
    plain = compute(train)
    gained = plain.with_root(5.0)
    rows, root = train.motion(0), [train.layout.slice(name) for name in ROOT]
    larger = np.ones(train.layout.dim)
    for columns in root:
        larger[columns] = 5.0
    np.testing.assert_allclose(gained.normalize(rows), plain.normalize(rows) * larger, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(plain.with_root(1.0).std, plain.std)


def test_still_columns_are_floored_and_no_frames_refused() -> None:
    layout = MotionLayout.named("body133")
    stats = from_moments(Moments.of(np.full((10, 133), 3.0)), layout)
    assert (stats.std == np.float32(STD_FLOOR)).all() and (stats.mean == 3).all()
    with pytest.raises(UserError, match="no frames"):
        from_moments(Moments.none(133), layout)


def test_normalize_and_back(train: ShardDataset) -> None:
    stats = compute(train)
    motion = train.motion(0)
    there = stats.normalize(motion)
    assert there.dtype == np.float32
    np.testing.assert_allclose(stats.denormalize(there), motion, atol=1e-5)
    for columns in (train.layout.part("body")[5:40:3], train.layout.slice("velocities")):
        normal = stats.normalize(motion[:, columns], columns)
        np.testing.assert_array_equal(normal, there[:, columns])
        np.testing.assert_allclose(stats.denormalize(normal, columns), motion[:, columns], atol=1e-5)
    again = pickle.loads(pickle.dumps(stats))
    np.testing.assert_array_equal(again.normalize(motion), there)


def test_saved_statistics_know_their_layout(train: ShardDataset, tmp_path: Path) -> None:
    stats = compute(train)
    stats.save(tmp_path / "stats.safetensors")
    loaded = FeatureStats.load(tmp_path / "stats.safetensors")
    np.testing.assert_array_equal(loaded.mean, stats.mean)
    np.testing.assert_array_equal(loaded.std, stats.std)
    assert loaded.layout == stats.layout and loaded.frames == stats.frames
    with pytest.raises(UserError, match="statistics"):
        FeatureStats.load(tmp_path / "none.safetensors")
    (tmp_path / "stats.safetensors").write_bytes(b"broken")
    with pytest.raises(UserError, match="not a statistics file"):
        FeatureStats.load(tmp_path / "stats.safetensors")


def test_groups_agree_with_humanml3d(shared: Path) -> None:
    features = np.load(shared / "golden/t1_humanml3d_A.npz", allow_pickle=False)
    golden = np.load(shared / "golden/t1_meanstd_A.npz", allow_pickle=False)
    rows = np.concatenate([features["h3d012314__feat263"], features["aist__feat263"]])
    layout = MotionLayout.named("h3d263")
    stats = from_moments(Moments.of(rows), layout, group=True)
    np.testing.assert_allclose(stats.mean, golden["mean263"], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(stats.std, golden["std263"], rtol=1e-5, atol=1e-6)
