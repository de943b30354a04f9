"""Motion stored as float16: everything reads it, and what it costs is bounded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from motionloom.datasets.check.dataset import check
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.loading.statistics import compute
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features import decode, encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.reading import CacheConfig, Reading


@pytest.fixture(scope="module")
def roots(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    whole, half = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("half")
    made.write(whole, count=40)
    made.write(half, count=40, motion_type="float16")
    return whole, half


def bound(values: np.ndarray) -> np.ndarray:
    """Half a unit in the last of float16's 11 bits, or of its smallest step."""
    return np.maximum(np.abs(values) * 2.0**-11, 2.0**-25)


def test_values_come_back_within_the_bound_from_half_the_bytes(roots: tuple[Path, Path]) -> None:
    whole, half = (ShardDataset.open(root, "train") for root in roots)
    for i in range(len(whole)):
        got, want = half.motion(i), whole.motion(i)
        assert got.dtype == np.float32 and got.shape == want.shape
        assert (np.abs(got - want) <= bound(want)).all()
        np.testing.assert_array_equal(got, want.astype(np.float16).astype(np.float32))
        assert half.texts(i) == whole.texts(i) and half.meta(i) == whole.meta(i)
    sizes = [sum(path.stat().st_size for path in root.glob("*.tar")) for root in roots]
    assert sizes[1] < 0.65 * sizes[0]
    assert check(roots[1]) == []


def test_every_reader_gives_the_same_values(
    roots: tuple[Path, Path], loopback: ModuleType, tmp_path: Path
) -> None:
    whole, half = (ShardDataset.open(root, "train") for root in roots)
    stats = compute(half)
    np.testing.assert_allclose(stats.mean, compute(whole).mean, atol=1e-4)
    np.testing.assert_allclose(stats.std, compute(whole).std, rtol=1e-3)

    def batch(dataset: ShardDataset | MixedDataset) -> np.ndarray:
        return WindowBatches(dataset, stats, window=16, batch_size=8, seed=1)[2]["motion"].numpy()

    streamed = Reading(mode="streamed", order="streamed", shards_per_group=2)
    with loopback.web(roots[1]) as (url, _):
        for gigabytes in (0.0, 1.0):
            cache = CacheConfig(folder=str(tmp_path / "cache"), gigabytes=gigabytes)
            remote = ShardDataset.open(url, "train", reading=Reading(cache=cache))
            np.testing.assert_array_equal(batch(remote), batch(half))
    one, other = (
        batch(ShardDataset.open(roots[1], "train", reading=r))
        for r in (streamed, streamed.model_copy(update={"mode": "indexed"}))
    )
    np.testing.assert_array_equal(one, other)
    batch(MixedDataset([(whole, 1.0), (half, 1.0)]))


def test_what_float16_cannot_hold_is_dropped_with_its_row(made: ModuleType, tmp_path: Path) -> None:
    def convert(i: int) -> object:
        sample = made.clip(i)
        if i == 1:
            motion = sample.motion.copy()
            motion[3, 5] = 70000.0
            sample = replace(sample, motion=motion)
        return sample

    manifest = made.write(tmp_path, count=10, convert=convert, motion_type="float16")
    assert [drop.source for drop in manifest.dropped] == ["1"]
    assert "row 3" in manifest.dropped[0].reason
    with pytest.raises(UserError):
        made.write(tmp_path / "strict", count=10, convert=convert, motion_type="float16", strict=True)


@pytest.mark.parametrize("name", ["body133", "wholebody313"])
def test_ten_seconds_of_joints_move_by_millimetres(name: str) -> None:
    """The heading and the place on the ground are sums over all frames before, so errors there add up."""
    layout = MotionLayout.named(name)
    time = np.arange(int(10 * layout.fps)) / layout.fps
    rng = np.random.default_rng(0)
    shape = (layout.num_joints, 3)
    sway = 0.1 * np.sin(rng.uniform(1, 9, shape) * time[:, None, None] + rng.uniform(0, 6, shape))
    joints = layout.skeleton.rest_joints + sway
    joints[..., 2] += 1.4 * time[:, None]
    joints = canonicalize(joints)
    features = encode(joints, layout)
    moved = decode(features.astype(np.float16).astype(np.float32), layout) - decode(features, layout)
    local = np.abs(moved - moved[:, :1]).max()
    print(f"{name}: {1e3 * np.abs(moved).max():.2f} mm, {1e3 * local:.2f} mm beside the root")
    assert np.abs(moved).max() < 0.01 and local < 0.002
