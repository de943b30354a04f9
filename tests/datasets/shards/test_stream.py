"""The streamed order and the streaming reader: the same batches as random access, and no silent damage."""

from __future__ import annotations

import io
import os
import pickle
import tarfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from text_samples import OneToken, caption_batches

from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.condition_batches import ConditionBatches
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.schema import ShardInfo, UserError
from motionloom.datasets.shards.access import read_shard
from motionloom.datasets.shards.cache import CacheConfig
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.order import Source
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.store import LocalStore
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache

GROUP = 2


@pytest.fixture(scope="module")
def root(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    made.write(root, count=120)  # 72 for training, in nine shards
    return root


@pytest.fixture(scope="module")
def stats(root: Path) -> FeatureStats:
    return compute(ShardDataset.open(root, "train"))


@pytest.fixture(scope="module")
def text(root: Path, tmp_path_factory: pytest.TempPathFactory) -> TextCache:
    train = ShardDataset.open(root, "train")
    captions = [c.text for i in range(len(train)) for c in train.texts(i) + train.face_texts(i)]
    return build_with_encoder(tmp_path_factory.mktemp("text"), captions, OneToken(), progress=False)


def opened(place: Path | str, mode: str, cache: CacheConfig | None = None) -> ShardDataset:
    reading = Reading.parse(
        {"mode": mode, "order": "streamed", "shards_per_group": GROUP, "cache": cache or CacheConfig()},
        "test",
    )
    return ShardDataset.open(place, "train", reading=reading)


def equal(one: Any, other: Any) -> bool:
    """Batches, their conditions included."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(value, other[key]) for key, value in one.items())
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else bool(one == other)


# --- the order -----------------------------------------------------------------------------------------


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


# --- the reader ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["folder", "web"])
def test_streamed_batches_equal_indexed_ones(
    place: str, root: Path, stats: FeatureStats, text: TextCache, loopback: ModuleType, tmp_path: Path
) -> None:
    def windows(data: ShardDataset, rank: int = 0, world: int = 1) -> WindowBatches:
        return WindowBatches(
            data, stats, window=16, batch_size=12, windows_per_clip=2, seed=3, rank=rank, world=world
        )

    def captions(data: ShardDataset, rank: int = 0, world: int = 1) -> ConditionBatches:
        return caption_batches(
            data, stats, text, batch_size=6, max_frames=40, min_frames=25, seed=3, rank=rank, world=world
        )

    def compare(where: Path | str, cache: CacheConfig | None) -> None:
        for build in (windows, captions):
            indexed, streamed = (build(opened(root, "indexed")), build(opened(where, "streamed", cache)))
            want = [indexed[k] for k in range(26)]
            assert all(equal(streamed[k], want[k]) for k in range(26)), "two epochs and more"
            resumed = build(opened(where, "streamed", cache))
            assert all(equal(resumed[k], want[k]) for k in (17, 18, 5)), "from any batch on"
            for k in (0, 13, 25):
                parts = [build(opened(where, "streamed", cache), rank, 2)[k] for rank in range(2)]
                again = [build(opened(root, "indexed"), rank, 2)[k] for rank in range(2)]
                assert all(equal(one, other) for one, other in zip(parts, again, strict=True))
                lengths = torch.cat([part["length"] for part in parts])
                assert torch.equal(lengths, want[k]["length"])

    if place == "folder":
        compare(root, None)
        return
    with loopback.web(root) as (url, _):
        compare(url, CacheConfig(folder=str(tmp_path)))


def test_each_shard_is_read_once_an_epoch_and_two_groups_are_held(
    root: Path, stats: FeatureStats, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: Counter[str] = Counter()
    real = LocalStore.open_shard

    def counted(store: LocalStore, shard: ShardInfo) -> Any:
        read[shard.name] += 1
        return real(store, shard)

    monkeypatch.setattr(LocalStore, "open_shard", counted)
    data = opened(root, "streamed")
    batches = WindowBatches(data, stats, window=16, batch_size=6, seed=3)
    assert batches.plan.batches_per_epoch == 12
    for k in range(12):
        batches[k]
        assert len(data._access._held) <= 2 * GROUP
        assert all(set(sample) == {"motion.npy"} for held in data._access._held.values() for sample in held)
    assert set(read.values()) == {1} and len(read) == 9
    read.clear()
    data.texts(0), data.texts(1)
    assert set(read.values()) == {1}, "a new kind of member reads the shard again, once"


# --- damage --------------------------------------------------------------------------------------------

Members = list[tuple[str, bytes]]


def members(path: Path) -> Members:
    with tarfile.open(path) as archive:
        return [(info.name, archive.extractfile(info).read()) for info in archive]


def tar(entries: Members, mode: str = "w") -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=mode, format=tarfile.USTAR_FORMAT) as archive:  # type: ignore[call-overload]
        for name, content in entries:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return out.getvalue()


def interleaved(entries: Members) -> Members:
    return sorted(entries, key=lambda entry: entry[0].partition(".")[2])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda m: tar(m[: next(i for i, e in enumerate(m) if "-000005." in e[0])]), ": 5 samples, .* 8"),
        (lambda m: tar(m)[:20000], "tar"),
        (lambda m: tar(m)[:-10240], "000001-0000"),
        (lambda m: tar(interleaved(m)), "sample '?0"),
        (lambda m: tar([*m, m[0]]), "the 8 of"),
        (lambda m: tar([m[0], *m]), "duplicate"),
        (lambda m: tar(m[1:]), "sample 0 .*000001-000000"),
        (lambda m: tar([(name, raw[:-1]) for name, raw in m]), "sample 0"),
        (lambda m: tar(m).replace(b"walks", b"jumps"), "sha256"),
        (lambda m: tar(m, "w:gz"), "000001-000000"),
        (lambda m: b"", "000001-000000"),
        (lambda m: b"000001-000000.x" + b"\0" * 2000, "no sample"),
    ],
)
def test_every_damage_stops_the_stream(
    root: Path, tmp_path: Path, damage: Callable[[Members], bytes], said: str
) -> None:
    data = ShardDataset.open(root, "train")
    shard = data._shards[1]
    (tmp_path / shard.name).write_bytes(damage(members(root / shard.name)))
    with pytest.raises(UserError, match=said) as raised:
        read_shard(LocalStore(tmp_path), shard, data._index, range(8, 16), {"motion.npy"})
    assert shard.name in str(raised.value)


class Payload:
    """Leaves a marker wherever it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return os.system, ("touch PWNED",)


@pytest.mark.parametrize("ending", ["pkl", "pyd", "pth", "motion.pkl"])
def test_members_with_code_stop_the_stream_unread(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    """WebDataset's decoders would run them, by the ending of the name."""
    monkeypatch.chdir(tmp_path)
    data = ShardDataset.open(root, "train")
    shard = data._shards[1]
    code = (f"000001-000000.{ending}", pickle.dumps(Payload()))
    first, *rest = members(root / shard.name)
    (tmp_path / shard.name).write_bytes(tar([first, code, *rest]))
    for wanted in ({"motion.npy"}, {"motion.npy", ending}):
        with pytest.raises(UserError, match=f"sample 0 is .*'{ending}'"):
            read_shard(LocalStore(tmp_path), shard, data._index, range(8, 16), wanted)
    assert [path.name for path in tmp_path.iterdir()] == [shard.name]


def test_no_environment_turns_a_shard_into_a_command(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """WebDataset's own opener follows GOPEN_REWRITE to a shell; it is never called."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GOPEN_REWRITE", f"{root}=pipe:touch PWNED; cat {root}")
    data = opened(root, "streamed")
    np.testing.assert_array_equal(data.motion(9), ShardDataset.open(root, "train").motion(9))
    assert not list(tmp_path.iterdir())
