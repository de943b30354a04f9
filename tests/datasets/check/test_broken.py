"""Every source file of the broken set is read or refused as its EXPECT.md demands."""

from __future__ import annotations

import io
import json
import math
import os
import tarfile
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import soundfile
import yaml
from shard_samples import write

from motionloom.datasets.audio.sound import MAX_RATE, read_sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest, ShardInfo
from motionloom.datasets.check.dataset import examine
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.bvh.read import read_motion
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.splits import read_ids
from motionloom.datasets.convert.motionx.parameters import value_limits
from motionloom.datasets.convert.smpl.smpl_npz import read_motion as read_amass
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.npz import NpzFile, map_npy
from motionloom.datasets.shards.index import read_index
from motionloom.datasets.shards.reader import ShardDataset, load_manifest
from motionloom.datasets.shards.tar import MOST_CLIPS, scan_tar
from motionloom.pipeline.inference.clip_file import read_clip

REJECTED: dict[str, list[str] | None] = yaml.safe_load(
    Path(__file__).with_name("broken.yaml").read_text("utf-8")
)
"""File -> words that the refusal must hold; None for a file that is to be read."""


def read_captions(path: Path) -> None:
    captions, problems = read_humanml_captions(path, seconds=10.0)
    if problems or not captions:
        raise UserError(f"{path}: {'; '.join(problems) or 'no captions'}")


READERS: dict[str, Callable[[Path], object]] = {
    "npy": lambda path: load_array(path, width=322, limit=value_limits()),
    "aist": read_aist_motion,
    "bvh": lambda path: read_motion(path.read_bytes(), str(path)),
    "texts": read_captions,
    "wav": read_sound,
    "splits": read_ids,
}


@pytest.fixture(autouse=True)
def untouched(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Runs in an empty folder, and fails if any payload ran or anything was written."""
    here = tmp_path / "cwd"
    here.mkdir()
    monkeypatch.chdir(here)
    broken = shared / "data" / "broken"
    before = sorted(broken.rglob("*"))
    yield here
    assert not list(here.iterdir()), "reading wrote something"
    assert not list(Path("/tmp").glob("PWNED_*")) and not list(tmp_path.rglob("PWNED_*"))
    assert sorted(broken.rglob("*")) == before


@pytest.fixture
def broken(shared: Path) -> Path:
    return shared / "data" / "broken"


@pytest.mark.parametrize("name", REJECTED)
def test_verdict(broken: Path, name: str) -> None:
    words, read = REJECTED[name], READERS[name.partition("/")[0]]
    if words is None:
        read(broken / name)
        return
    with pytest.raises(UserError) as refused:  # no exception of any other class
        read(broken / name)
    assert str(refused.value).startswith(f"{broken / name}:")
    for word in words:
        assert word in str(refused.value)


def test_the_table_has_every_file(broken: Path) -> None:
    there = {str(path.relative_to(broken)) for path in broken.rglob("*.*") if path.parent.name in READERS}
    assert there == set(REJECTED) and len(there) == 50


# Files that ask for memory or time without end: each is refused with one sentence before it is read.

HEAD = "HIERARCHY\nROOT {name}\n{{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
MOTION = "MOTION\nFrames: 1\nFrame Time: 0.05\n{}\n"


def nested(count: int) -> str:
    joint = "JOINT j\n{\nOFFSET 0 1 0\nCHANNELS 0\n"
    return HEAD.format(name="r") + joint * count + "}\n" * (count + 1) + MOTION.format("0 0 0")


def index_of(shape: tuple[int, ...]) -> io.BytesIO:
    """An index whose first array declares a shape, well packed."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<i4", "fortran_order": False, "shape": shape})
    raw = io.BytesIO()
    with zipfile.ZipFile(raw, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("train.frames.npy", header.getvalue() + bytes(4 * shape[0]))
    return raw


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def huge(path: Path) -> Path:
    with path.open("wb") as file:
        file.truncate(2**40)
    return path


def tar_of(path: Path, clips: int) -> Path:
    with tarfile.open(path, "w") as archive:
        for number in range(clips):
            for member in ("motion.npy", "meta.json"):
                archive.addfile(tarfile.TarInfo(f"{number:06d}.{member}"))
    return path


def long_name(path: Path, size: int) -> Path:
    info = tarfile.TarInfo()
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, size
    path.write_bytes(info.tobuf(tarfile.GNU_FORMAT))
    os.truncate(path, 2 * size)
    return path


def device(folder: Path) -> Path:
    (folder / "manifest.json").symlink_to("/dev/zero")
    return folder


ONE = [ShardInfo(name="x-train-000000.tar", split="train", samples=1, frames=9, bytes=9, sha256="0")]
PIPED: tuple[Callable[[Path], object], ...] = (
    Manifest.load_json, JointMap.load, scan_tar, NpzFile, read_clip, read_sound,
    lambda path: BodyModel.load(path, "smpl22"), lambda path: Captions.read([path]).rows,
    lambda path: check_array_header(path, width=1), read_bvh, map_npy, FeatureStats.load,
)  # fmt: skip
HOSTILE: dict[str, Callable[[Path], object]] = {
    "an index that declares 64 MiB for one clip": lambda f: read_index(index_of((2**24,)), "i", "train", ONE),
    "a manifest that is a device": lambda f: load_manifest(device(f)),
    **{f"a pipe {number}": lambda f, read=read: read(pipe(f / "x")) for number, read in enumerate(PIPED)},
    "a manifest of a terabyte": lambda f: load_manifest(huge(f / "manifest.json").parent),
    "captions that are a device": lambda f: Captions.read([Path("/dev/zero")]).rows,
    "a shard whose next name takes 8 GiB": lambda f: scan_tar(long_name(f / "x.tar", 2**33)),
    "a shard of too many clips": lambda f: scan_tar(tar_of(f / "x.tar", MOST_CLIPS + 1)),
    "a shard of more clips than its manifest has": lambda f: scan_tar(tar_of(f / "x.tar", 9), most=8),
    "3,000 nested joints": lambda f: read_bvh(nested(3_000)),
    "100,000 nested joints": lambda f: read_bvh(nested(100_000)),
    "a joint's name of a megabyte": lambda f: read_bvh(nested(1).replace("JOINT j", "JOINT " + "j" * 2**20)),
    "a place of 1e308": lambda f: read_bvh(nested(1).replace("0 0 0\n", "1e308 0 0\n")),
    "an angle of 1e308": lambda f: read_bvh(HEAD.format(name="r") + "}\n" + MOTION.format("0 1e308 0")),
    "much silence in a few kilobytes": lambda f: read_sound(silence(f / "x.flac", 900, 48_000)),
    "more than an hour": lambda f: read_sound(silence(f / "x.wav", 3700, 100)),
}


def silence(path: Path, seconds: int, rate: int) -> Path:
    with soundfile.SoundFile(path, "w", samplerate=rate, channels=1) as file:
        for _ in range(seconds):
            file.write(np.zeros(rate, np.int16))
    return path


@pytest.mark.parametrize("read", HOSTILE.values(), ids=HOSTILE.keys())
def test_endless_files_are_refused_in_one_sentence(read: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path)
    assert len(str(caught.value)) < 500 and "\n" not in str(caught.value)


def packed(path: Path, **shapes: tuple[str, tuple[int, ...]]) -> Path:
    """An npz of zeros of these types and shapes: a thousandth of their length."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, (kind, shape) in shapes.items():
            with archive.open(f"{name}.npy", "w") as file:
                header = {"descr": kind, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
                size = np.dtype(kind).itemsize * math.prod(shape)
                for start in range(0, size, 2**20):
                    file.write(bytes(min(2**20, size - start)))
    return path


WIDE: dict[str, Callable[[Path, str, int], object]] = {
    "AMASS": lambda path, kind, n: read_amass(
        packed(path, poses=(kind, (n, 165)), trans=(kind, (n, 3))), "x", hands=True
    ),
    "a clip": lambda path, kind, n: read_clip(packed(path, joints=(kind, (n, 22, 3)), face=(kind, (n, 50)))),
    "a body": lambda path, kind, n: BodyModel.load(
        packed(path, kintree_table=("<u4", (2, 24)), v_template=(kind, (n, 3))), "smpl22"
    ),
    "numbers": lambda path, kind, n: NpzFile(packed(path, a=(kind, (n, 99)))).numbers("a"),
}


@pytest.mark.parametrize("kind", ["|u1", "<f2", "<f4"])
@pytest.mark.parametrize("read", WIDE.values(), ids=WIDE.keys())
@pytest.mark.parametrize("frames", [20_000, 300_000])
def test_arrays_take_no_more_than_their_file_allows(
    read: Callable[[Path, str, int], object], kind: str, frames: int, tmp_path: Path
) -> None:
    """20 times the file and 200 MB, after the conversion to float64 too."""
    path = tmp_path / "x.npz"
    tracemalloc.start()
    try:
        with suppress(UserError):
            read(path, kind, frames)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak <= 20 * path.stat().st_size + 200e6


def test_sound_of_a_high_rate_is_brought_down_while_it_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    soundfile.write(tmp_path / "x.flac", rng.uniform(-0.5, 0.5, 655_350), 655_350)
    samples, rate = read_sound(tmp_path / "x.flac")
    assert rate == MAX_RATE and abs(len(samples) - rate) <= 1
    assert read_sound(tmp_path / "x.flac", rate=96_000)[1] == 96_000


def test_a_check_looks_at_every_number(tmp_path: Path) -> None:
    """A manifest with a frame rate that no motion has, and a pipe in the place of a shard."""
    made = write(tmp_path / "set")
    data = json.loads((tmp_path / "set/manifest.json").read_text())
    (tmp_path / "set/manifest.json").write_text(json.dumps(data | {"fps": 1e308}))
    assert examine(tmp_path / "set").errors
    with pytest.raises(UserError, match="fps"):
        ShardDataset.open(tmp_path / "set", "train")
    write(tmp_path / "other")
    shard = tmp_path / "other" / made.shards[0].name
    shard.unlink()
    assert any("plain file" in problem.message for problem in examine(pipe(shard).parent).errors)
