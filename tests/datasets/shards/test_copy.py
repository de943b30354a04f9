"""A data set carried to a bucket, a folder or the hub's stand-in: resumed, compared, whole or not at all."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from fsspec.implementations.local import LocalFileSystem

from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.removed import remove
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards import store
from motionloom.datasets.shards.copy import copy_dataset
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.store import open_store


@pytest.fixture
def data(root: Path, tmp_path: Path) -> Path:
    """The data set, to be changed."""
    return Path(shutil.copytree(root, tmp_path / "data"))


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def aws(loopback: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A server with the empty bucket `shards`, of which one request in five fails."""
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.setattr(store, "FIRST_PAUSE", 0.001)
    with loopback.bucket(empty, every=5) as (environment, network):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield network


def test_to_a_bucket_and_back(aws: Any, data: Path, tmp_path: Path) -> None:
    count = len(files(data))
    assert copy_dataset(str(data), "s3://shards/a/b") == (count, 0)
    assert aws.failures
    assert copy_dataset(str(data), "s3://shards/a/b") == (0, count)
    assert ShardDataset.open("s3://shards/a/b", "val").ids == ShardDataset.open(data, "val").ids
    back = tmp_path / "deep" / "back"
    assert copy_dataset("s3://shards/a/b", str(back)) == (count, 0)
    assert files(back) == files(data) and check(back) == []
    with pytest.raises(UserError, match="no such bucket"):
        copy_dataset(str(data), "s3://nowhere/x")
    with pytest.raises(UserError, match="only read"):
        copy_dataset(str(data), "http://127.0.0.1:1/x")


def test_a_damaged_byte_at_either_end_is_found(aws: Any, data: Path) -> None:
    aws.every = 0
    copy_dataset(str(data), "s3://shards/x")
    shard = data / "made-val-000000.tar"
    whole = shard.read_bytes()
    damaged = whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:]
    there = open_store("s3://shards/x")
    there.system().pipe_file(there.where(shard.name), damaged)
    assert copy_dataset(str(data), "s3://shards/x").sent == 1, "the damaged one alone"
    assert there.system().cat_file(there.where(shard.name)) == whole
    shard.write_bytes(damaged)
    with pytest.raises(UserError, match=rf"{shard.name}: the sha256"):
        copy_dataset(str(data), "s3://shards/y")
    assert not open_store("s3://shards/y").system().exists("s3://shards/y/manifest.json")


KILLED = """
import os, signal, sys
from motionloom.datasets.shards import copy
carry, count = copy._carry, 0
def killed(here, there, name, *rest):
    global count
    count += 1
    if count == 5:
        there.system().pipe_file(there.where(name), b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    return carry(here, there, name, *rest)
copy._carry = killed
copy.copy_dataset(sys.argv[1], sys.argv[2])
"""


def test_killed_in_the_middle_and_given_again(aws: Any, data: Path, tmp_path: Path) -> None:
    for target in ("s3://shards/k", str(tmp_path / "k")):
        process = subprocess.run([sys.executable, "-P", "-c", KILLED, str(data), target], env=os.environ)
        assert process.returncode == -signal.SIGKILL
        with pytest.raises(UserError, match=r"no manifest\.json"):
            ShardDataset.open(target, "train")
        assert copy_dataset(str(data), target) == (len(files(data)) - 4, 4)
        assert ShardDataset.open(target, "train").motion(0).tobytes()
    assert files(tmp_path / "k") == files(data)


def test_a_later_state_takes_the_place_of_an_older_one(
    aws: Any, made: ModuleType, data: Path, tmp_path: Path
) -> None:
    aws.every = 0
    gone = ShardDataset.open(data, "test").ids[0]
    for there in ("s3://shards/later", str(tmp_path / "there")):
        copy_dataset(str(data), there)
    copies = copy_dataset(str(data), there).kept
    remove(data, ids=[gone])
    for there in ("s3://shards/later", str(tmp_path / "there")):
        assert copy_dataset(str(data), there).kept > copies // 2, "other shards are as they were"
        assert gone not in ShardDataset.open(there, "test").ids
    assert files(tmp_path / "there") == files(data) and check(data) == []
    assert not any(f'"{gone}"'.encode() in content for content in files(tmp_path / "there").values())
    less = tmp_path / "less"
    made.write(less, count=20)
    copy_dataset(str(less), there)
    assert files(tmp_path / "there") == files(less)
    made.write(tmp_path / "other", count=8, name="other")
    with pytest.raises(UserError, match="holds data set 'made', not 'other'"):
        copy_dataset(str(tmp_path / "other"), there)
    (data / "index.npz").unlink()
    with pytest.raises(UserError, match=r"index\.npz"):
        copy_dataset(str(data), str(tmp_path / "new"))
    assert not (tmp_path / "new" / "manifest.json").exists()


class Hub(LocalFileSystem):
    """The interface of the hub's file system on a folder: a big file's sha256 is in its record."""

    protocol = "hf"
    root = ""

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(Path(cls.root, path.removeprefix("hf://").lstrip("/"))) if "hf://" in path else path

    def info(self, path: str, **options: Any) -> dict[str, Any]:
        import hashlib

        found = super().info(path, **options)
        if path.endswith(".tar"):
            found["lfs"] = {"sha256": hashlib.sha256(Path(found["name"]).read_bytes()).hexdigest()}
        return found


def test_a_data_set_of_the_hub(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Hub, "root", str(tmp_path / "hub"))
    monkeypatch.setattr(store, "_connect", lambda *_: Hub(auto_mkdir=True, skip_instance_cache=True))
    remove(data, ids=ShardDataset.open(data, "test").ids[:1])
    place = "hf://datasets/owner/name"
    told = {name: content for name, content in files(data).items() if name != "removed.json"}
    count = len(told)
    assert copy_dataset(str(data), place) == (count, 0) and copy_dataset(str(data), place) == (0, count)
    assert files(tmp_path / "hub" / "datasets" / "owner" / "name") == told
    assert ShardDataset.open(place, "val").ids == ShardDataset.open(data, "val").ids
