"""The cache of downloaded shards: a size limit, whole files only, shared by processes."""

from __future__ import annotations

import hashlib
import multiprocessing
from pathlib import Path
from types import ModuleType

import pytest

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards import store as retry
from motionloom.datasets.shards.cache import CacheConfig, FileCache
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset


def content(number: int) -> tuple[str, bytes]:
    data = bytes([number]) * 1000
    return f"{hashlib.sha256(data).hexdigest()}.tar", data


def test_the_cache_keeps_what_was_used_last(tmp_path: Path) -> None:
    cache = FileCache(CacheConfig(folder=str(tmp_path), gigabytes=3.5e-6))
    made: list[int] = []

    def get(number: int) -> bytes:
        name, data = content(number)

        def make(path: Path) -> None:
            made.append(number)
            path.write_bytes(data)

        with cache.get(name, 1000, make) as file:
            return file.read()

    for number in (1, 2, 3, 1, 4, 1, 2):
        assert get(number) == content(number)[1]
        assert sum(path.stat().st_size for path in tmp_path.glob("*.tar")) <= 3500
    assert made == [1, 2, 3, 4, 2]
    held = cache.get(content(2)[0], 1000, lambda path: None)
    for number in (5, 6, 7):
        get(number)
    assert not (tmp_path / content(2)[0]).exists() and held.read() == content(2)[1], (
        "open files stay readable"
    )
    with pytest.raises(UserError, match="larger than the cache's limit of 3500; raise its gigabytes"):
        cache.get(content(9)[0], 4000, lambda path: None)
    assert not list(tmp_path.glob(".*.part"))


def test_other_files_in_its_folder_are_never_deleted(tmp_path: Path) -> None:
    """A recipe, also a stranger's, names the folder."""
    others = [
        "thesis.tar",
        "photo.jpg",
        ".hidden",
        "film.part",
        ".film.part",
        "f" * 64,
        f"{'f' * 64}.tar.part",
    ]
    for name in others:
        (tmp_path / name).write_bytes(bytes(5000))
    cache = FileCache(CacheConfig(folder=str(tmp_path), gigabytes=1.5e-6))
    for number in (1, 2, 3):
        name, data = content(number)
        cache.get(name, 1000, lambda path, data=data: path.write_bytes(data)).close()
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == sorted([*others, name])


def test_a_failed_or_killed_download_leaves_nothing_behind(tmp_path: Path) -> None:
    cache = FileCache(CacheConfig(folder=str(tmp_path), gigabytes=1e-5))
    name, data = content(1)
    with pytest.raises(UserError, match="refused"):
        cache.get(name, 1000, lambda path: (path.write_bytes(data[:10]), retry.persist("x", refuse)))
    assert not [path for path in tmp_path.iterdir() if path.is_file()]
    (tmp_path / f".{content(2)[0]}.part").write_bytes(b"left by a killed process")
    cache.get(name, 1000, lambda path: path.write_bytes(data)).close()
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == [name]


def refuse() -> None:
    raise UserError("refused")


def fetch_all(url: str, folder: str, out: multiprocessing.Queue) -> None:
    reading = Reading(cache=CacheConfig(folder=folder, gigabytes=6e-4))
    dataset = ShardDataset.open(url, "train", reading=reading)
    out.put(float(sum(dataset.motion(i).sum() for _ in range(2) for i in range(len(dataset)))))


def test_processes_share_one_small_cache(loopback: ModuleType, root: Path, tmp_path: Path) -> None:
    local = ShardDataset.open(root, "train")
    sizes = [shard.bytes for shard in local._shards]
    assert max(sizes) < 6e5 < sum(sizes), "the limit must force some shards out"
    want = float(sum(local.motion(i).sum() for _ in range(2) for i in range(len(local))))
    context = multiprocessing.get_context("fork")
    with loopback.web(root) as (url, _):
        out = context.Queue()
        workers = [
            context.Process(target=fetch_all, args=(url, str(tmp_path / "cache"), out)) for _ in range(3)
        ]
        for worker in workers:
            worker.start()
        assert [out.get(timeout=60) for _ in workers] == [want] * 3
        for worker in workers:
            worker.join()
    left = [path for path in (tmp_path / "cache").iterdir() if path.is_file()]
    assert not [path for path in left if path.name.startswith(".")]
    assert sum(path.stat().st_size for path in left) <= 6e5


def test_processes_that_want_one_file_download_it_once(
    loopback: ModuleType, root: Path, tmp_path: Path
) -> None:
    context = multiprocessing.get_context("fork")
    with loopback.web(root) as (url, seen):
        out = context.Queue()
        big = str(tmp_path / "cache")
        workers = [context.Process(target=fetch_shared, args=(url, big, out)) for _ in range(4)]
        for worker in workers:
            worker.start()
        for worker in workers:
            out.get(timeout=60)
            worker.join()
        shards = [line for line in seen if ".tar" in line]
        assert len(shards) == len(set(shards)) == 5


def fetch_shared(url: str, folder: str, out: multiprocessing.Queue) -> None:
    dataset = ShardDataset.open(url, "train", reading=Reading(cache=CacheConfig(folder=folder)))
    out.put(float(sum(dataset.motion(i).sum() for i in range(len(dataset)))))
