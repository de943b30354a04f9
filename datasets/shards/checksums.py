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
from motionloom.datasets.base.files import State, sha256_of, state_of
from motionloom.datasets.base.json_doors import require_plain
from motionloom.datasets.base.records import ShardInfo

_ADVICE = "copy it back or convert again"


class LocalShard(NamedTuple):
    """A shard in a folder of this machine."""

    path: Path
    info: ShardInfo

    def state(self) -> State:
        return state_of(self.path)


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
