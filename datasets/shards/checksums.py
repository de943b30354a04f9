"""Shards of a folder compared with the sha256 of their manifest.

The indexed reader reads single clips, so a flipped bit would be trained on unnoticed. Whole
files are compared before they are read, at the speed of the disk; size, times and inode show later changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.base.json_doors import require_plain
from motionloom.datasets.base.records import ShardInfo

State = list[int]
"""Size, times and inode of a file (`state_of`)."""
_ADVICE = "copy it back or convert again"


class LocalShard(NamedTuple):
    """A shard in a folder of this machine."""

    path: Path
    info: ShardInfo

    def state(self) -> State:
        return state_of(self.path)


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


def require_intact(shard: LocalShard, *, content: bool = True) -> None:
    """Refuse a shard that is missing, has another size or, where `content` is compared, another sha256."""
    try:
        fault = fault_of(shard, content=content)
    except FileNotFoundError:
        fault = "the shard is missing"
    except OSError as error:
        fault = f"cannot be read ({error.strerror})"
    if fault:
        raise UserError(f"{shard.path}: {fault}; {_ADVICE}")


def fault_of(shard: LocalShard, *, content: bool = True) -> str:
    """Return in words how a shard differs from the manifest; empty if it does not."""
    require_plain(shard.path)
    size = shard.path.stat().st_size
    if size != shard.info.bytes:
        return f"{size} bytes, the manifest says {shard.info.bytes}: truncated or changed"
    if content and sha256_of(shard.path) != shard.info.sha256:
        return "the sha256 is not the manifest's: damaged or changed"
    return ""


def problems(
    shards: Sequence[LocalShard], threads: int, done: Callable[[], object] = lambda: None
) -> list[str]:
    """Return the faults of shards, in order; `done` is called after each. Hashing releases the GIL."""

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
