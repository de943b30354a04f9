"""How the bytes of one clip's member are reached: in a mapped file, or by requests.

An access is made for one split and answers `member(shard, clip, column)` with a buffer and the byte in it
where the member starts. (`stream.StreamedShards` is the third kind.)
"""

from __future__ import annotations

import mmap
from collections import OrderedDict
from collections.abc import Collection, Sequence
from typing import Protocol

from numpy.typing import NDArray

from motionloom.datasets.schema import ShardInfo, UserError
from motionloom.datasets.shards.index import SplitIndex
from motionloom.datasets.shards.sample import MEMBERS
from motionloom.datasets.shards.store import Store

OPEN_SHARDS = 256
"""Shards mapped at a time in one process; the least recently used is let go."""


Buffer = bytes | mmap.mmap


class Access(Protocol):
    """Reaches the members of a split's clips."""

    def member(self, shard: int, clip: int, column: int) -> tuple[Buffer, int]:
        """(buffer, its byte where the member starts) of the clip's member `MEMBERS[column]`."""
        ...

    def prefetch(self, places: Sequence[tuple[int, int]], members: Collection[str]) -> None:
        """Called before a batch is made, with the (shard, clip) of its clips and the members it will read."""
        ...


class MappedShards:
    """Files of this machine, memory-mapped: the page cache is the only cache and all processes share it."""

    def __init__(self, store: Store, shards: list[ShardInfo], index: SplitIndex, room: int = 0) -> None:
        self.maps: OrderedDict[int, mmap.mmap] = OrderedDict()
        self._store, self._shards, self._offsets = store, shards, index.offsets
        self._most = OPEN_SHARDS
        if room:  # a deleted file takes disk space while it is mapped: at most an eighth of the cache may
            self._most = max(1, min(OPEN_SHARDS, room // (8 * max(shard.bytes for shard in shards))))

    def member(self, shard: int, clip: int, column: int) -> tuple[Buffer, int]:
        """See `Access`. Views keep a dropped map alive until they go, so letting go is always safe."""
        found = self.maps.get(shard)
        if found is None:
            found = self._map(shard)
        else:
            self.maps.move_to_end(shard)
        return found, int(self._offsets[clip, column])

    def prefetch(self, places: Sequence[tuple[int, int]], members: Collection[str]) -> None:
        """Nothing to do: the kernel reads ahead."""

    def _map(self, shard: int) -> mmap.mmap:
        info = self._shards[shard]
        where = self._store.where(info.name)
        with self._store.open_shard(info) as file:
            try:
                found = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except (OSError, ValueError) as error:
                raise UserError(f"{where}: cannot be read ({error})") from None
        if len(found) != info.bytes:
            raise UserError(
                f"{where}: {len(found)} bytes, the manifest says {info.bytes}: truncated while in use"
            )
        self.maps[shard] = found
        while len(self.maps) > self._most:
            self.maps.popitem(last=False)
        return found


class RangedShards:
    """A range request for each member; those of one batch are made at the same time."""

    def __init__(self, store: Store, shards: list[ShardInfo], index: SplitIndex) -> None:
        self._store, self._shards = store, shards
        self._offsets: NDArray = index.offsets
        self._sizes: NDArray = index.sizes
        self._held: dict[tuple[int, int], bytes] = {}

    def member(self, shard: int, clip: int, column: int) -> tuple[Buffer, int]:
        """See `Access`."""
        found = self._held.get((clip, column))
        if found is None:
            found = self._store.read_pieces([self._piece(shard, clip, column)])[0]
        return found, 0

    def prefetch(self, places: Sequence[tuple[int, int]], members: Collection[str]) -> None:
        """See `Access`: read them all, in place of what was read before."""
        columns = [MEMBERS.index(member) for member in members]
        wanted = {
            (clip, column): self._piece(shard, clip, column)
            for shard, clip in places
            for column in columns
            if self._sizes[clip, column]
        }
        self._held = dict(zip(wanted, self._store.read_pieces(list(wanted.values())), strict=True))

    def _piece(self, shard: int, clip: int, column: int) -> tuple[str, int, int]:
        start = int(self._offsets[clip, column])
        return self._shards[shard].name, start, start + int(self._sizes[clip, column])
