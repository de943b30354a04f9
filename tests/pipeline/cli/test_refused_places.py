"""Every command that writes, where it cannot: a file in the way, closed folders, a disk that takes no more or
cannot be read.

The third is real: with a limit on the size of files the system refuses what goes beyond, in the middle of a
write and for root too.
"""

from __future__ import annotations

import ctypes
import errno
import io
import os
import re
import resource
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from bvh_clips import write_clip, write_map

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def places(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run, its shards and a BVH source, all free to change."""
    root = tmp_path_factory.mktemp("places")
    shutil.copytree(small_run.folder, root / "run")
    shutil.copy(small_run.recipe, root / "small.yaml")
    shutil.copytree(small_run.folder / "stages" / "data" / "shards", root / "shards")
    (root / "mocap").mkdir()
    for seed, name in enumerate("ab"):
        write_clip(root / "mocap" / f"{name}.bvh", seed)
    write_map(root / "map.json")
    return root


@contextmanager
def no_room(size: int) -> Iterator[None]:
    """Files may grow to `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def rights() -> Iterator[None]:
    """Rights of files hold for root, too: without the capabilities DAC_OVERRIDE and DAC_READ_SEARCH."""
    libc = ctypes.CDLL(None)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    before = (ctypes.c_uint32 * 6)()
    libc.capget(header, before)
    libc.capset(header, (ctypes.c_uint32 * 6)(before[0] & ~0b110, *before[1:]))
    try:
        yield
    finally:
        libc.capset(header, before)


class BadDisk(io.FileIO):
    """A file whose bytes do not come."""

    def __init__(self, path: str, *_: object) -> None:
        super().__init__(path)

    def read(self, *_: object) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    readinto = readall = read  # type: ignore[assignment]


WRITING: dict[str, Sequence[str]] = {
    "run": ("run", "{root}/small.yaml", "--out", "{out}", "--until", "data"),
    "generate": ("generate", "{root}/run", "a person waves", "--seconds", "2", "--out", "{out}"),
    "evaluate": ("evaluate", "{root}/run", "--clips", "4"),
    "report": ("report", "{root}/run", "--out", "{out}/page.html"),
    "table": ("evaluate", "--table", "humantomato/7", "{root}/run", "--out", "{out}/seven.md"),
    "export": ("export", "{root}/run", "--out", "{out}"),
    "data synth": ("data", "synth", "{out}", "--clips", "3", "--workers", "1"),
    "data convert": (
        "data", "convert", "bvh", "{root}/mocap", "{out}", "--set", "joint_map={root}/map.json",
        "--licence", "x", "--workers", "1",
    ),
    "data copy": ("data", "copy", "{root}/shards", "{out}"),
    "data report": ("data", "report", "{root}/shards", "--out", "{out}/page.html"),
}  # fmt: skip


def words_of(name: str, root: Path, out: Path) -> list[str]:
    return [word.format(root=root, out=out) for word in WRITING[name]]


def files_of(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


def require_sentence(answer: Any) -> str:
    assert answer.code == 2, answer.out + answer.err
    said = str(answer.err)
    assert re.search(r"^error: ", said, re.MULTILINE) and "Traceback" not in said
    assert "Errno" not in said and ".tmp" not in said
    return said[said.index("error: ") :]  # behind what was said of the motions


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("name", sorted(set(WRITING) - {"evaluate"}))
def test_a_place_that_takes_nothing(
    name: str, closed: bool, places: Path, tmp_path: Path, call: Call
) -> None:
    place = tmp_path / "place"
    place.mkdir(0o555) if closed else place.write_text("here")
    with rights():
        error = require_sentence(call(*words_of(name, places, place / "below")))
    assert str(place) in error and ("no permission" in error) == closed
    assert [*tmp_path.rglob("*")] == [place]


UNREAD = {
    "30.ckpt": ("run", "{root}/small.yaml", "--out", "{root}/run", "--until", "tokenizer"),
    "stats.safetensors": ("run", "{root}/small.yaml", "--out", "{root}/run", "--until", "tokenizer"),
    "a.bvh": WRITING["data convert"],
    "train-000000.tar": WRITING["data copy"],
    "index.npz": WRITING["data report"],
}


@pytest.mark.parametrize("why", ["disk", "rights"])
@pytest.mark.parametrize("name", UNREAD)
def test_what_cannot_be_read_is_no_damage(
    name: str, why: str, places: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(places, tmp_path, dirs_exist_ok=True)
    (tmp_path / "run/stages/tokenizer/artifact.json").unlink()
    before = files_of(tmp_path)
    opened = io.open
    if why == "rights":
        for path in tmp_path.rglob(f"*{name}"):
            path.chmod(0)
    else:
        bad = lambda at, *how, **more: (BadDisk if str(at).endswith(name) else opened)(at, *how, **more)  # noqa: E731
        monkeypatch.setattr(io, "open", bad)
    with rights():
        answer = call(*(word.format(root=tmp_path, out=tmp_path / "out") for word in UNREAD[name]))
    if (name, why) == ("a.bvh", "rights"):  # a closed file is left out, and said
        assert answer.code == 0 and "1 unreadable file" in answer.out
    else:
        assert name in require_sentence(answer) and files_of(tmp_path) >= before


@pytest.mark.parametrize("name", sorted(set(WRITING) - {"table"}))
def test_a_disk_that_takes_no_more(name: str, places: Path, tmp_path: Path, call: Call) -> None:
    out = tmp_path / "out"
    with no_room(2000):
        answer = call(*words_of(name, places, out))
    error = require_sentence(answer)
    assert "larger than" in error or "is the disk full?" in error
    assert str(out) in error or (name in ("evaluate", "report") and str(places / "run") in error)
    # What has got its own name is whole, and nothing else is there.
    assert all(path.stat().st_size < 2000 for path in files_of(out))
    assert not [path for path in files_of(tmp_path) if path.suffix in (".tmp", ".html")]
    if name == "export":
        assert not out.exists() and not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["report", "table", "data report"])
def test_a_page_takes_the_place_of_no_data(name: str, places: Path, tmp_path: Path, call: Call) -> None:
    words = words_of(name, places, tmp_path)
    words[-1] = str(tmp_path / "manifest.json")
    (tmp_path / "manifest.json").write_text("{}")
    assert "name a file that ends in ." in require_sentence(call(*words))
    assert (tmp_path / "manifest.json").read_text() == "{}"
