"""Files that are either whole or absent: every atomic write and every checksum of the package."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

from motionloom.datasets.base.os_errors import naming

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}\.tmp")


class HashingFile:
    """A write-only binary file that keeps the sha256 of everything written (no second read of a shard)."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._sha256 = hashlib.sha256()

    def write(self, data: bytes) -> int:
        self._sha256.update(data)
        return self._file.write(data)

    @property
    def hexdigest(self) -> str:
        return self._sha256.hexdigest()


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A path to write to; the file moves to `path`, synced, only when the block ends without error.

    Parent folders are made. The temporary name starts with a dot and ends in a random number, so no worker,
    of an earlier run or on another machine, can rename another's half-written file into place. An error of
    the system names `path`, never the temporary file. What exists and is no plain file (a device, a pipe) is
    never replaced: the content is written into it.
    """
    if _takes_bytes(path):
        with temporary_folder() as folder:
            yield folder / path.name
            with (folder / path.name).open("rb") as file, path.open("wb") as into:
                shutil.copyfileobj(file, into)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, as a rename is atomic only within one file system.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        with naming(path, str(temporary), temporary):
            yield temporary
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
    finally:
        with suppress(OSError):  # the error that ended the block says more
            temporary.unlink(missing_ok=True)


def _takes_bytes(path: Path) -> bool:
    """Whether a path is a device or a pipe, or, as /dev/stdout is, a name for an open file."""
    try:
        kind = path.stat().st_mode
    except OSError:
        return False
    named = path.is_symlink() and str(path.readlink()).startswith("/proc/")
    return named or not (stat.S_ISREG(kind) or stat.S_ISDIR(kind))


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file that moves to `path`, as by `atomic_path`."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file


def remove_temporaries(folder: Path) -> None:
    """Delete what killed writers left in `folder`. Call it only while nothing else can be writing there."""
    for path in folder.iterdir():
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


@contextmanager
def temporary_folder(place: Path | None = None, name: str = "motionloom") -> Iterator[Path]:
    """A folder in `place`, by default the system's for such things, which is gone when the block ends.

    What killed processes have left of this name there is removed first: the kernel frees their lock on their
    folder. Where the file system has no locks, it stays.
    """
    parent = Path(tempfile.gettempdir()) if place is None else place
    for left in parent.iterdir():
        if left.name.startswith(f".{name}.") and _TEMPORARY.fullmatch(left.name):
            _remove_left(left)
    folder = parent / f".{name}.{secrets.token_hex(8)}.tmp"
    new = folder.with_suffix(".new")  # nobody takes it for a left one before it is locked
    new.mkdir(0o700 if place is None else 0o777)
    handle = os.open(new, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        new.rename(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def _remove_left(folder: Path) -> None:
    """Remove a folder of ours whose lock nobody holds."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            if os.fstat(handle).st_uid == os.geteuid():
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
        finally:
            os.close(handle)


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes atomically; a file that holds them stays as it is, also where nothing can be written."""
    if path.is_file() and not path.is_symlink() and path.stat().st_size == len(data) > 0:
        with suppress(OSError):
            if path.read_bytes() == data:
                return
    with atomic_file(path) as file:
        file.write(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically, newlines as they are."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_json(path: Path, data: object, *, sort_keys: bool = False, allow_nan: bool = False) -> None:
    """Write JSON atomically; equal data give equal bytes. Keys keep their order unless `sort_keys`."""
    text = json.dumps(data, indent=1, ensure_ascii=False, sort_keys=sort_keys, allow_nan=allow_nan)
    # Bytes of a file's name that are no UTF-8 are lone surrogates here, which no reader of JSON takes.
    write_text(path, re.sub("[\ud800-\udfff]", lambda half: f"\\\\u{ord(half[0]):x}", text) + "\n")


def is_file(path: Path) -> bool:
    """Whether there is a file of that name, which may be one that no file can have, of 5,000 letters."""
    try:
        return path.is_file()
    except OSError:
        return False


def sync_folder(folder: Path) -> None:
    """Make renames and deletions in `folder` survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of(path: Path) -> str:
    """sha256 of a file's content, hex."""
    with naming(path), path.open("rb") as file:
        return hashlib.file_digest(cast(Any, file), "sha256").hexdigest()


State = list[int]
"""Size, times and inode of a file (`state_of`)."""


def state_of(path: Path) -> State:
    """Return size, times and inode, which change when somebody writes or replaces a file; empty without one.

    The time of the last change of any kind (ctime) is the system's own: a copy that restores the time of the
    last write, as rsync does, is seen, and so are files of two machines that lie under one path.
    """
    try:
        status = path.stat()
    except OSError:
        return []
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def sha256_of_json(value: object) -> str:
    """sha256 of plain JSON data, hex; the order of keys makes no difference."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def sorted_header(raw: bytes) -> bytes:
    """Return a safetensors file with its header's keys in order; the library writes them in random order."""
    end = 8 + int.from_bytes(raw[:8], "little")
    header = json.dumps(json.loads(raw[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + raw[end:]
