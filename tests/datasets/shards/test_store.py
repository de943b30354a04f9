"""Remote data: only allowed schemes, retries, clear refusals, and a bounded cache that processes share."""

from __future__ import annotations

import hashlib
import multiprocessing
import pickle
import shutil
import sys
import threading
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.statistics import compute
from motionloom.datasets.shards import store as retry
from motionloom.datasets.shards.cache import CacheConfig, FileCache
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import FETCHING, ShardDataset
from motionloom.datasets.shards.store import LocalStore, RemoteStore, open_store


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_PAUSE", 0.001)


def reading(tmp_path: Path) -> Reading:
    return Reading(cache=CacheConfig(folder=str(tmp_path / "cache"), gigabytes=1.0))


def same(one: ShardDataset, other: ShardDataset) -> None:
    assert one.ids == other.ids and np.array_equal(one.frames, other.frames)
    for i in range(len(one)):
        np.testing.assert_array_equal(one.motion(i), other.motion(i))
        assert one.texts(i) == other.texts(i) and one.face_texts(i) == other.face_texts(i)
        assert one.meta(i) == other.meta(i)
        assert np.array_equal(one.array(i, "audio.npy"), other.array(i, "audio.npy"))
        for a, b in zip(one.wav(i) or (), other.wav(i) or (), strict=True):
            assert np.array_equal(a, b)


OTHER_SCHEMES = ("ftp://host/'x y'", "ssh://host/x", "python:x", "memory://x")


@pytest.mark.parametrize(
    "place", ["pipe:touch PWNED|", "PIPE:touch PWNED", "simplecache::s3://b/c", *OTHER_SCHEMES]
)
def test_other_schemes_are_refused_before_anything_opens(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(UserError, match=r"file:, http:, https:, s3:, gs:, az:, hf:"):
        ShardDataset.open(place, "train")
    assert not list(tmp_path.iterdir())


def test_urls_that_carry_more_than_a_place_are_refused_and_file_urls_are_folders(root: Path) -> None:
    for place in ("https://me:secret@host/data", "s3://key:secret@bucket/data"):
        with pytest.raises(UserError, match="credentials") as raised:
            open_store(place)
        assert "secret" not in str(raised.value)
    for place in ("https://host/data?token=1", "https://host/data#x", "s3://bucket/../other", "s3:///data"):
        with pytest.raises(UserError, match=r"'\?', '#'"):
            open_store(place)
    with pytest.raises(UserError, match="file:///folder"):
        open_store("file://host/share")
    with pytest.raises(UserError, match="file:///folder"):
        open_store("file:data")
    assert isinstance(open_store(f"file://{root}"), LocalStore)
    same(ShardDataset.open(f"file://{root}", "val"), ShardDataset.open(root, "val"))


def test_a_web_server_gives_what_the_folder_gives(loopback: ModuleType, root: Path, tmp_path: Path) -> None:
    with loopback.web(root) as (url, seen):
        for split in ("train", "val"):
            remote = ShardDataset.open(url, split, reading=reading(tmp_path))
            assert not any(".tar" in line for line in seen), "opening reads no shard"
            same(remote, ShardDataset.open(root, split))
            seen[:] = [line for line in seen if split not in line]
        cached = sorted(path.suffix for path in (tmp_path / "cache").iterdir() if path.is_file())
        assert cached.count(".tar") == 7 and cached.count(".npz") == 1
        again = ShardDataset.open(url, "train", reading=reading(tmp_path))
        seen.clear()
        sent = pickle.dumps(again)
        assert len(sent) < 1000
        copy = pickle.loads(sent)
        copy.motion(0)
        assert not seen, "a worker opens from the cache"


def test_an_s3_bucket_behind_a_bad_network(
    loopback: ModuleType, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    with loopback.bucket(root, every=3) as (environment, network):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        remote = ShardDataset.open("s3://shards/made", "val", reading=reading(tmp_path))
        same(remote, ShardDataset.open(root, "val"))
        assert network.failures >= 1
        network.every = 0
        for place, says in (
            ("s3://no-such-bucket/x", "no such bucket"),
            ("s3://shards/other", "no manifest"),
        ):
            with pytest.raises(UserError, match=says):
                ShardDataset.open(place, "val", reading=reading(tmp_path))
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.delenv(name)
        monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
        with pytest.raises(UserError, match="credentials"):
            ShardDataset.open("s3://shards/made", "val", reading=reading(tmp_path))


def test_what_will_not_pass_is_said_at_once(
    loopback: ModuleType, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    status = 403

    def refuse(request: BaseHTTPRequestHandler, number: int) -> bool:
        request.send_error(status)
        return True

    with loopback.web(root, answer=refuse) as (url, seen):
        for status, said in (
            (401, "AWS_ACCESS_KEY_ID"),
            (403, "AWS_ACCESS_KEY_ID"),
            (404, r"manifest\.json"),
            (400, "HTTP 400"),
        ):
            seen.clear()
            with pytest.raises(UserError, match=said):
                ShardDataset.open(url, "train", reading=reading(tmp_path))
            assert len(seen) == 1, f"{status} is no reason to try again"
        for status in (429, 500, 502, 503):
            seen.clear()
            with pytest.raises(UserError, match=f"{status}.*tried 8 times"):
                ShardDataset.open(url, "train", reading=reading(tmp_path))
            assert len(seen) == retry.ATTEMPTS
    monkeypatch.setattr(retry.time, "sleep", lambda _: pytest.fail("nobody listening is no reason to wait"))
    with pytest.raises(UserError, match=r"127\.0\.0\.1"):
        ShardDataset.open(url, "train", reading=reading(tmp_path))
    monkeypatch.setattr(retry, "ATTEMPTS", 1)
    with pytest.raises(UserError, match=r"manifest\.json: .*tried 1 times"):
        ShardDataset.open("http://nowhere.invalid/x", "train", reading=reading(tmp_path))


def test_pauses_grow_and_leave_the_runs_random_numbers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_PAUSE", 1.0)
    pauses: list[float] = []
    monkeypatch.setattr(retry.time, "sleep", pauses.append)
    import random

    before = random.getstate()

    def down() -> None:
        raise ConnectionResetError("reset")

    with pytest.raises(UserError, match="x: reset"):
        retry.persist("x", down)
    assert random.getstate() == before
    wholes = [1, 2, 4, 8, 15, 15, 15]
    assert all(whole / 2 <= pause <= whole for pause, whole in zip(pauses, wholes, strict=True))
    with pytest.raises(ZeroDivisionError):
        retry.persist("x", lambda: 1 // 0)


def test_two_nodes_fetch_the_set_once_together_and_ahead(
    made: ModuleType, loopback: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each with a cache of a seventh of the set; after the first batch no reader waits for a download."""
    made.write(tmp_path / "data", 1200, clips_per_shard=8)
    whole = ShardDataset.open(tmp_path / "data", "train", reading=Reading(order="streamed"))
    stats = compute(whole)
    by: list[str] = []

    def fetch(*given: Any, real: Any = RemoteStore._fetch) -> None:
        by.append(threading.current_thread().name)
        real(*given)

    monkeypatch.setattr(RemoteStore, "_fetch", fetch)
    shards = [shard for shard in whole.manifest.shards if shard.split == "train"]
    room = sum(shard.bytes for shard in shards) / 7e9
    with loopback.web(tmp_path / "data") as (url, seen):
        for rank in range(2):
            share = Share(rank, 2)
            cache = CacheConfig(folder=str(tmp_path / f"cache{rank}"), gigabytes=room)
            remote = ShardDataset.open(url, "train", reading=Reading(order="streamed", cache=cache))
            nodes = [WindowBatches(d, stats, window=8, batch_size=16, share=share) for d in (remote, whole)]
            seen.clear()
            for k in range(nodes[0].plan.batches_per_epoch - 4):  # behind them is the next epoch's beginning
                assert torch.equal(nodes[0][k]["motion"], nodes[1][k]["motion"])
                for thread in threading.enumerate():
                    if thread.name == FETCHING:
                        thread.join()
                if k == 0:
                    assert len(seen) <= 2 * 4 + 1, "those of four streams, and their next ones"
                    by.clear()
            assert set(by) == {FETCHING} and len(seen) == len(set(seen)) <= 1.1 * len(shards) / 2


@pytest.fixture
def copy(root: Path, tmp_path: Path) -> Path:
    """The data set, to be changed."""
    return Path(shutil.copytree(root, tmp_path / "data"))


def test_damage_on_the_server_is_named(loopback: ModuleType, copy: Path, tmp_path: Path) -> None:
    shard = copy / "made-val-000000.tar"
    whole = shard.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 4
    for content, said in ((bytes(flipped), "sha256"), (whole[:-10240], "truncated")):
        shard.write_bytes(content)
        with loopback.web(copy) as (url, _), pytest.raises(UserError, match=rf"val-000000\.tar: .*{said}"):
            ShardDataset.open(url, "val", reading=reading(tmp_path)).motion(0)
    assert not [
        path for path in (tmp_path / "cache").iterdir() if "part" in path.name or path.suffix == ".tar"
    ]
    shard.write_bytes(whole)
    (copy / "index.npz").write_bytes((copy / "index.npz").read_bytes()[:-400])
    with loopback.web(copy) as (url, _), pytest.raises(UserError, match=r"index\.npz"):
        ShardDataset.open(url, "val", reading=reading(tmp_path / "other"))


def test_a_manifest_that_changes_while_in_use_is_refused(
    loopback: ModuleType, copy: Path, tmp_path: Path
) -> None:
    with loopback.web(copy) as (url, _):
        places = (copy, url)
        sent = [pickle.dumps(ShardDataset.open(p, "val", reading=reading(tmp_path))) for p in places]
        manifest = copy / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"CC0"', '"CC1"'))
        with pytest.raises(UserError, match=r"manifest\.json"):
            pickle.loads(sent[0])
        pickle.loads(sent[1]).motion(0)  # has its own copy
        for path in (tmp_path / "cache").glob("*.manifest.json"):
            path.unlink()
        with pytest.raises(UserError, match=r"manifest\.json"):
            pickle.loads(sent[1])


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
    with pytest.raises(UserError, match=r"3500.*gigabytes"):
        cache.get(content(9)[0], 4000, lambda path: None)
    assert not list(tmp_path.glob(".*.part"))


def test_other_files_in_its_folder_are_never_deleted(tmp_path: Path) -> None:
    """A recipe, also a stranger's, names the folder."""
    others = ["thesis.tar", ".hidden", "film.part", ".film.part", "f" * 64, f"{'f' * 64}.tar.part"]
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


def sum_of(dataset: ShardDataset) -> float:
    """Every motion, twice."""
    return float(sum(dataset.motion(i).sum() for _ in range(2) for i in range(len(dataset))))


def read_all(url: str, cache: CacheConfig, out: multiprocessing.Queue) -> None:
    out.put(sum_of(ShardDataset.open(url, "train", reading=Reading(cache=cache))))


@pytest.mark.parametrize("gigabytes", [6e-4, 1.0])
def test_processes_share_one_cache(
    loopback: ModuleType, root: Path, tmp_path: Path, gigabytes: float
) -> None:
    """One that is too small for all shards, and one in which each is downloaded once."""
    local = ShardDataset.open(root, "train")
    sizes = [shard.bytes for shard in local._shards]
    assert max(sizes) < 6e5 < sum(sizes), "the smaller limit must force some shards out"
    context = multiprocessing.get_context("fork")
    cache = CacheConfig(folder=str(tmp_path / "cache"), gigabytes=gigabytes)
    with loopback.web(root) as (url, seen):
        out = context.Queue()
        workers = [context.Process(target=read_all, args=(url, cache, out)) for _ in range(4)]
        for worker in workers:
            worker.start()
        assert [out.get(timeout=60) for _ in workers] == [sum_of(local)] * 4
        for worker in workers:
            worker.join()
        shards = [line for line in seen if ".tar" in line]
    assert len(set(shards)) == 5 and (len(shards) == 5) == (gigabytes == 1.0)
    left = [path for path in (tmp_path / "cache").iterdir() if path.is_file()]
    assert not [path for path in left if path.name.startswith(".")]
    assert sum(path.stat().st_size for path in left) <= gigabytes * 1e9
