"""Shards of a folder compared with the sha256 of their manifest.

The indexed reader maps files and takes clips out of them, so a flipped bit would be trained on without a
word. Whole files are compared before they are read, at the speed of the disk, and what a file was like then
tells whether it has been touched since.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, cast

from motionloom.datasets.schema import ShardInfo, UserError

_ADVICE = "copy it back or convert again"


class LocalShard(NamedTuple):
    """A shard in a folder of this machine."""

    path: Path
    info: ShardInfo

    def state(self) -> list[int]:
        return state_of(self.path)


def state_of(path: Path) -> list[int]:
    """Return size, times and inode, which change when somebody writes or replaces a file; empty without one.

    The time of the last change of any kind (ctime) is the system's own: a copy that restores the time of the
    last write, as rsync does, is seen, and so are files of two machines that lie under one path.
    """
    try:
        status = path.stat()
    except OSError:
        return []
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def require_intact(shard: LocalShard, *, content: bool = True) -> None:
    """Refuse a shard that is missing, has another size or, where `content` is compared, another sha256."""
    path, info = shard
    try:
        size = path.stat().st_size
    except OSError:
        raise UserError(f"{path}: the shard is missing; {_ADVICE}") from None
    if size != info.bytes:
        raise UserError(
            f"{path}: {size} bytes, the manifest says {info.bytes}: truncated or changed; {_ADVICE}"
        )
    if not content:
        return
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(cast(Any, file), "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {_ADVICE}") from None
    if digest != info.sha256:
        raise UserError(f"{path}: the sha256 is not the manifest's: damaged; {_ADVICE}")


def problems(
    shards: Sequence[LocalShard], threads: int, done: Callable[[], object] = lambda: None
) -> list[str]:
    """Return the faults of shards, in their order; `done` is called for each that has been compared.

    Hashing runs outside the interpreter's lock.
    """

    def problem(shard: LocalShard) -> str | None:
        try:
            require_intact(shard)
        except UserError as error:
            return str(error)
        return None

    faults = []
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for fault in pool.map(problem, shards):
            if fault is not None:
                faults.append(fault)
            done()
    return faults
