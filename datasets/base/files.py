"""Files that are either whole or absent: atomic writes and checksums."""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}\.tmp")


class HashingFile:
    """A write-only binary file that keeps the sha256 of everything written (no second read of a shard)."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._sha256 = hashlib.sha256()

    def write(self, data: bytes) -> int:
        """Write and hash."""
        self._sha256.update(data)
        return self._file.write(data)

    @property
    def hexdigest(self) -> str:
        """sha256 so far."""
        return self._sha256.hexdigest()


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A binary file that appears under `path` only when the block ends without error, synced.

    The temporary name starts with a dot and ends in a random number, so no worker, of an earlier run or on
    another machine, can rename another's half-written file into place.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def remove_temporaries(folder: Path) -> None:
    """Delete what killed writers left in `folder`. Only for who knows that nobody is writing there."""
    for path in folder.iterdir():
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically; the same data gives the same bytes."""
    with atomic_file(path) as file:
        file.write(json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n")


def write_with(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a file that then appears atomically."""
    with atomic_file(path) as file:
        write(file)


def sync_folder(folder: Path) -> None:
    """Make renames and deletions in `folder` survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of(path: Path) -> str:
    """sha256 of a file's content, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(cast(Any, file), "sha256").hexdigest()
