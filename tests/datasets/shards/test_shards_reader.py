"""Reading shards: zero-copy views, refusals that name shard and key, and a million clips opened quickly."""

from __future__ import annotations

import io
import json
import os
import tarfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.check.dataset import check
from motionloom.datasets.shards import reader
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.tar import scan_tar


@pytest.fixture
def root(made: ModuleType, tmp_path: Path) -> Path:
    made.write(tmp_path / "data")
    return tmp_path / "data"


def test_every_member_comes_back(made: ModuleType, root: Path) -> None:
    for split, count in (("train", 36), ("val", 12), ("test", 12)):
        dataset = ShardDataset.open(root, split)
        assert len(dataset) == len(dataset.ids) == count
        for i in range(count):
            number = int(dataset.ids[i].rpartition("-")[2])
            want = made.clip(number, split)
            motion = dataset.motion(i)
            np.testing.assert_array_equal(motion, want.motion)
            assert motion.dtype == np.float32 and not motion.flags.writeable and motion.base is not None
            assert dataset.frames[i] == len(motion) == dataset.meta(i).frames
            assert dataset.meta(i) == want.meta
            assert dataset.texts(i) == want.texts and dataset.face_texts(i) == want.face_texts
            audio, sound = dataset.array(i, "audio.npy"), dataset.wav(i)
            assert (audio is None) == (want.audio is None) and (sound is None) == (want.wav is None)
            if audio is not None:
                np.testing.assert_array_equal(audio, want.audio)
            if sound is not None:
                np.testing.assert_allclose(sound[0], want.wav[0], atol=2**-15)
                assert sound[1] == 8000


@pytest.mark.parametrize(("room", "opens"), [(3, 11), (100, 10)])
def test_a_shard_is_opened_once_where_descriptors_suffice(
    made: ModuleType, root: Path, monkeypatch: pytest.MonkeyPatch, room: int, opens: int
) -> None:
    """Two data sets of five shards each, then one shard again; three descriptors serve both."""
    monkeypatch.setattr(reader, "open_shards", lambda: room)
    dataset, other = (ShardDataset.open(root, "train") for _ in range(2))
    opened: list[str] = []
    monkeypatch.setattr(os, "open", lambda path, *a, real=os.open: [opened.append(path), real(path, *a)][1])
    for some, count in ((dataset, 36), (other, 36), (dataset, 4)):
        for i in range(count):
            want = made.clip_motion(int(some.ids[i].rpartition("-")[2]))
            np.testing.assert_array_equal(some.motion(i), want)
            np.testing.assert_array_equal(some.motion(i, 3, 19), want[3:19])
    assert len(opened) == opens and len(dataset._access.files) + len(other._access.files) == min(room, 10)


def test_a_shard_that_is_cut_short_or_replaced_while_in_use_is_named(root: Path) -> None:
    dataset = ShardDataset.open(root, "train")
    dataset.motion(0)
    paths = sorted(root.glob("made-train-*.tar"))
    os.truncate(paths[0], 512)
    paths[1].unlink()
    os.mkfifo(paths[1])
    for clip in (0, 8):
        with pytest.raises(UserError, match=rf"{paths[clip // 8].name}: "):
            dataset.motion(clip)


def test_damage_is_named(root: Path) -> None:
    assert check(root) == []
    shard = root / "made-train-000002.tar"
    content = shard.read_bytes()
    shard.write_bytes(content[:-10240])
    with pytest.raises(UserError, match=r"made-train-000002\.tar: \d+ bytes"):
        ShardDataset.open(root, "train")
    shard.unlink()
    with pytest.raises(UserError, match=r"made-train-000002\.tar: "):
        ShardDataset.open(root, "train")
    assert any(problem.where == "made-train-000002.tar" for problem in check(root))
    shard.write_bytes(content)
    (root / "manifest.json").unlink()
    with pytest.raises(UserError, match=r"manifest\.json"):
        ShardDataset.open(root, "train")


def test_every_flipped_bit_of_a_shard_is_found(made: ModuleType, tmp_path: Path) -> None:
    root = tmp_path / "data"
    made.write(root, 20, clips_per_shard=2)
    shards = {path: path.read_bytes() for path in sorted(root.glob("*.tar"))}
    rng = np.random.default_rng(0)
    rounds = -(-100 // len(shards))
    for _ in range(rounds):
        for path, content in shards.items():
            flipped = bytearray(content)
            flipped[rng.integers(len(content))] ^= 1 << rng.integers(8)
            path.write_bytes(flipped)
        found = {problem.where for problem in check(root) if "sha256" in problem.message}
        assert found >= {path.name for path in shards}
    for path, content in shards.items():
        path.write_bytes(content)
    assert check(root) == []


def test_a_forged_index_cannot_lead_outside_a_shard(root: Path) -> None:
    path = root / "index.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    for name, row, value in (
        ("train.offsets", (3, 4), 2**40),
        ("train.data", (3,), -5),
        ("train.frames", (3,), 10**6),
        ("train.sizes", (3, 4), 2**31),
        ("train.id_ends", (3,), 10**9),
        ("train.itemsize", (3,), 8),
    ):
        forged = {key: values.copy() for key, values in arrays.items()}
        forged[name][row] = value
        np.savez(path, **forged)
        with pytest.raises(UserError, match=r"index\.npz"):
            ShardDataset.open(root, "train")
        assert check(root)
    np.savez(path, **{**arrays, "train.frames": np.array([object()] * 36)})
    with pytest.raises(UserError, match="not a readable index"):
        ShardDataset.open(root, "train")
    path.write_bytes(b"no zip")
    with pytest.raises(UserError, match="not a readable index"):
        ShardDataset.open(root, "train")


def test_a_manifest_cannot_name_files_elsewhere(root: Path) -> None:
    path = root / "manifest.json"
    data = json.loads(path.read_text())
    data["shards"][0]["name"] = "../made-train-000000.tar"
    path.write_text(json.dumps(data))
    with pytest.raises(UserError, match="shard"):
        ShardDataset.open(root, "train")


def entry(
    name: str, content: bytes = b"{}", kind: bytes = tarfile.REGTYPE, size: int | None = None
) -> tuple[tarfile.TarInfo, bytes]:
    info = tarfile.TarInfo(name)
    info.type = kind
    info.linkname = "/etc/passwd" if kind != tarfile.REGTYPE else ""
    info.size = (len(content) if size is None else size) if kind == tarfile.REGTYPE else 0
    return info, content


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ([entry("../a.meta.json")], "path"),
        ([entry("/a.meta.json")], "path"),
        ([entry("a\\b.meta.json")], "path"),
        ([entry("C:a.meta.json")], "path"),
        ([entry("a.meta.json", kind=tarfile.SYMTYPE)], "is a link"),
        ([entry("a.meta.json", kind=tarfile.LNKTYPE)], "is a link"),
        ([entry("a.meta.json", kind=tarfile.DIRTYPE)], "folder"),
        ([entry("a.evil.pkl")], "not a known member"),
        ([entry("a.meta.json"), entry("a.meta.json")], "appears twice"),
        ([entry("a.meta.json"), entry("b.meta.json"), entry("a.motion.npy")], "missing field"),
        (
            [entry(f"{key}.{kind}") for key in "aba" for kind in ("meta.json", "motion.npy")],
            "duplicate key 'a'",
        ),
        ([entry("a.meta.json")], "key 'a' has no motion.npy"),
        ([entry("a.meta.json", kind=tarfile.FIFOTYPE)], "device"),
        ([entry("a.meta.json", kind=tarfile.CHRTYPE)], "device"),
        ([entry("a.meta.json", size=2**40)], "truncated inside 'a.meta.json'"),
    ],
)
def test_hostile_tars_are_refused(
    tmp_path: Path, entries: list[tuple[tarfile.TarInfo, bytes]], said: str
) -> None:
    path = tmp_path / "x-train-000000.tar"
    with tarfile.open(path, "w") as archive:
        for info, content in entries:
            if info.size > len(content):  # a header that lies
                archive.fileobj.write(info.tobuf(tarfile.GNU_FORMAT) + content)
            else:
                archive.addfile(info, io.BytesIO(content))
    with pytest.raises(UserError, match=said) as raised:
        scan_tar(path)
    assert path.name in str(raised.value)


def rewrite(shard: Path, change: Callable[[str, bytes], bytes]) -> None:
    """Replace members of a shard in place."""
    with tarfile.open(shard) as archive:
        members = [(info, archive.extractfile(info).read()) for info in archive]
    with tarfile.open(shard, "w", format=tarfile.USTAR_FORMAT) as archive:
        for info, content in members:
            content = change(info.name, content)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


def test_check_finds_an_id_of_another_split(root: Path) -> None:
    train, val = (ShardDataset.open(root, split).ids[0].encode() for split in ("train", "val"))
    rewrite(root / "made-val-000000.tar", lambda name, raw: raw.replace(val, train))
    assert any(f"id '{train.decode()}'" in str(problem) for problem in check(root))
