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

    def readinto(self, *_: object) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    read = readall = readinto  # type: ignore[assignment]


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


@pytest.mark.parametrize("name", sorted(set(WRITING) - {"evaluate"}))
def test_a_file_in_the_way(name: str, places: Path, tmp_path: Path, call: Call) -> None:
    (tmp_path / "file").write_text("here")
    error = require_sentence(call(*words_of(name, places, tmp_path / "file" / "below")))
    assert str(tmp_path / "file") in error
    assert files_of(tmp_path) == {tmp_path / "file"}


@pytest.mark.parametrize("name", sorted(set(WRITING) - {"evaluate"}))
def test_a_closed_folder(name: str, places: Path, tmp_path: Path, call: Call) -> None:
    tmp_path.chmod(0o555)
    with rights():
        error = require_sentence(call(*words_of(name, places, tmp_path / "out")))
    assert str(tmp_path) in error and "no permission" in error and not list(tmp_path.iterdir())


TRAINED = ("run", "{root}/small.yaml", "--out", "{out}", "--until", "tokenizer")
UNREAD = {
    "newest checkpoint": (TRAINED, "30.ckpt"),
    "statistics": (TRAINED, "stats.safetensors"),
    "motion": (WRITING["data convert"], "a.bvh"),
    "shard": (WRITING["data copy"], "train-000000.tar"),
    "index": (WRITING["data report"], "index.npz"),
}


@pytest.mark.parametrize("why", ["disk", "rights"])
@pytest.mark.parametrize("name", UNREAD)
def test_what_cannot_be_read_is_no_damage(
    name: str, why: str, places: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, file = UNREAD[name]
    for folder in ("run", "shards", "mocap"):
        shutil.copytree(places / folder, tmp_path / folder)
    out = tmp_path / ("run" if words is TRAINED else "out")
    (tmp_path / "run/stages/tokenizer/artifact.json").unlink()
    opened = io.open
    if why == "rights":
        for path in tmp_path.rglob(f"*{file}"):
            path.chmod(0)
    else:
        bad = lambda path, mode="r", *rest, **how: (  # noqa: E731
            io.BufferedReader(BadDisk(path)) if str(path).endswith(file) else opened(path, mode, *rest, **how)
        )
        monkeypatch.setattr(io, "open", bad)
    before = files_of(tmp_path)
    with rights():
        given = [
            word.replace("{root}/small", f"{places}/small").format(root=tmp_path, out=out) for word in words
        ]
        answer = call(*(word.replace(f"{tmp_path}/map", f"{places}/map") for word in given))
    if (name, why) == ("motion", "rights"):  # one that is closed is left out, and said
        assert answer.code == 0 and "1 unreadable file" in answer.out
        return
    assert file in require_sentence(answer) and files_of(tmp_path) >= before


@pytest.mark.parametrize("name", sorted(set(WRITING) - {"table"}))
def test_a_disk_that_takes_no_more(name: str, places: Path, tmp_path: Path, call: Call) -> None:
    out = tmp_path / "out"
    with no_room(2000):
        answer = call(*words_of(name, places, out))
    error = require_sentence(answer)
    assert "larger than" in error or "is the disk full?" in error
    assert str(places / "run" if name in ("evaluate", "report") else out) in error
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


def test_a_checkpoint_that_finds_no_room(places: Path, tmp_path: Path, call: Call) -> None:
    run = tmp_path / "run"
    shutil.copytree(places / "run", run)
    with no_room(30_000):
        answer = call(
            "run", places / "small.yaml", "--out", run, "--from", "tokenizer", "--until", "tokenizer"
        )
    assert str(run) in require_sentence(answer)
    assert not list((run / "stages" / "tokenizer").rglob("*.ckpt"))
    assert not (run / "stages" / "tokenizer" / "artifact.json").exists()
    # Nothing is in the way of the same command once there is room.
    again = call("run", places / "small.yaml", "--out", run, "--until", "tokenizer")
    assert again.code == 0, again.err
