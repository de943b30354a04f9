"""Access to the bytes of a clip: in a mapped file, or in whole shards in memory.

An access is made for one split and answers `member(shard, clip, column)` with a buffer and the byte in it
where the member starts. Whole shards are read front to back through WebDataset: the index says which clips a
batch holds, so a stream gives the same batches as random access, bit for bit, and starts at any batch.

What WebDataset would pass over in silence stops the read here: its samples are compared with the index and
the shard's sha256 with the manifest. It gets streams that our store opened and never a name it could open by
itself (its own opener runs shell commands for `pipe:`), and nothing is decoded by it.
"""

from __future__ import annotations

import hashlib
import io
import mmap
import tarfile
from collections import OrderedDict
from collections.abc import Collection
from typing import BinaryIO

from motionloom.datasets.schema import ShardInfo, UserError
from motionloom.datasets.shards.index import SplitIndex
from motionloom.datasets.shards.sample import MEMBERS
from motionloom.datasets.shards.store import Store

OPEN_SHARDS = 256
"""Shards mapped at a time in one process; the least recently used is let go."""


Buffer = bytes | mmap.mmap


class MappedShards:
    """Files of this machine, memory-mapped: the page cache is the only cache and all processes share it."""

    def __init__(self, store: Store, shards: list[ShardInfo], index: SplitIndex, room: int = 0) -> None:
        self.maps: OrderedDict[int, mmap.mmap] = OrderedDict()
        self._store, self._shards, self._offsets = store, shards, index.offsets
        self._most = OPEN_SHARDS
        if room:  # a deleted file takes disk space while it is mapped: at most an eighth of the cache may
            self._most = max(1, min(OPEN_SHARDS, room // (8 * max(shard.bytes for shard in shards))))

    def member(self, shard: int, clip: int, column: int) -> tuple[Buffer, int]:
        """(buffer, its byte where the member starts). Views keep a map that is let go alive."""
        mapped = self.maps.get(shard)
        if mapped is None:
            mapped = self._map(shard)
        else:
            self.maps.move_to_end(shard)
        return mapped, int(self._offsets[clip, column])

    def _map(self, shard: int) -> mmap.mmap:
        info = self._shards[shard]
        where = self._store.where(info.name)
        with self._store.open_shard(info) as file:
            try:
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except (OSError, ValueError) as error:
                raise UserError(f"{where}: cannot be read ({error})") from None
        if len(mapped) != info.bytes:
            raise UserError(
                f"{where}: {len(mapped)} bytes, the manifest says {info.bytes}: truncated while in use"
            )
        self.maps[shard] = mapped
        while len(self.maps) > self._most:
            self.maps.popitem(last=False)
        return mapped


GROUPS_HELD = 2
"""A batch may begin in one group of shards and end in the next."""


class StreamedShards:
    """Access to a split through whole shards in memory; `group` is the order's `shards_per_group`."""

    def __init__(
        self, store: Store, shards: list[ShardInfo], index: SplitIndex, first: list[int], group: int
    ) -> None:
        self._store, self._shards, self._index, self._first = store, shards, index, first
        self._most = GROUPS_HELD * group
        self._held: OrderedDict[int, list[dict[str, bytes]]] = OrderedDict()
        self._members: set[str] = set()

    def member(self, shard: int, clip: int, column: int) -> tuple[bytes, int]:
        """A member never asked for before has the shard read again, then is kept too."""
        name = MEMBERS[column]
        if name not in self._members:
            self._members.add(name)
            self._held.clear()
        self._load({shard})
        return self._held[shard][clip - self._first[shard]][name], 0

    def prefetch(self, shards: set[int], members: Collection[str]) -> None:
        """Read the shards of a batch, with the members it will ask for."""
        if not self._members.issuperset(members):
            self._members.update(members)
            self._held.clear()
        self._load(shards)

    def _load(self, wanted: set[int]) -> None:
        for shard in sorted(wanted):
            if shard in self._held:
                self._held.move_to_end(shard)
                continue
            # The oldest shard goes, but none that this batch itself still reads.
            while len(self._held) >= self._most:
                oldest = next((held for held in self._held if held not in wanted), None)
                if oldest is None:
                    break  # the batch itself needs more shards than two groups have
                del self._held[oldest]
            rows = range(self._first[shard], self._first[shard + 1])
            self._held[shard] = read_shard(self._store, self._shards[shard], self._index, rows, self._members)


Access = MappedShards | StreamedShards


def read_shard(
    store: Store, shard: ShardInfo, index: SplitIndex, rows: range, members: Collection[str]
) -> list[dict[str, bytes]]:
    """The chosen members of every clip of a shard, in order; `UserError` when it is not what the index says.

    `rows` are the shard's rows of the index.
    """
    # Brings in torch.
    from webdataset.tariterators import group_by_keys, tar_file_expander

    where = store.where(shard.name)
    number = shard.name.removesuffix(".tar").rpartition("-")[2]
    clips: list[dict[str, bytes]] = []
    with store.open_shard(shard) as file:
        # Hashed as it is read: the sha256 is known at the end of the one pass over the file.
        stream = _Hashed(file)
        # tarfile would also unpack a compressed file; ours begin with the first key.
        if not stream.starts_with(f"{number}-000000.".encode()):
            raise UserError(f"{where}: does not begin with sample '{number}-000000': {_ADVICE}")
        try:
            files = tar_file_expander(iter([{"url": where, "stream": stream}]))
            for sample in group_by_keys(files, lcase=False):
                _compare(where, sample, f"{number}-{len(clips):06d}", index, rows, len(clips))
                clips.append({name: sample[name] for name in members if name in sample})
        except (tarfile.TarError, EOFError, ValueError) as error:
            reason = str(error.args[0] if error.args else error).partition(" @ <")[0][:200]
            last = (
                f"the last whole sample is '{number}-{len(clips) - 1:06d}'" if clips else "no sample is whole"
            )
            raise UserError(f"{where}: not readable ({reason}), {last}: {_ADVICE}") from None
        if len(clips) != len(rows):
            raise UserError(f"{where}: {len(clips)} samples, the index says {len(rows)}: {_ADVICE}")
        if stream.hexdigest() != shard.sha256:
            raise UserError(f"{where}: the sha256 is not the manifest's: {_ADVICE}")
    return clips


_ADVICE = "truncated, mixed up or changed; copy it back or convert again"


def _compare(where: str, sample: dict, key: str, index: SplitIndex, rows: range, place: int) -> None:
    """Key, members and sizes of one sample are those of its row of the index."""
    if place >= len(rows):
        raise UserError(f"{where}: more samples than the {len(rows)} of the index: {_ADVICE}")
    members = {name: len(value) for name, value in sample.items() if not name.startswith("__")}
    sizes = index.sizes[rows[place]].tolist()
    wanted = {name: size for name, size in zip(MEMBERS, sizes, strict=True) if size}
    if sample["__key__"] != key or members != wanted:
        raise UserError(
            f"{where}: sample {place} is '{sample['__key__']}' with {members}, "
            f"the index says '{key}' with {wanted}: {_ADVICE}"
        )


class _Hashed:
    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._sha256 = hashlib.sha256()

    def starts_with(self, head: bytes) -> bool:
        """Return whether the stream begins so; reads nothing off it."""
        assert isinstance(self._file, io.BufferedReader)
        return self._file.peek(len(head))[: len(head)] == head

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self._sha256.update(data)
        return data

    def hexdigest(self) -> str:
        """sha256 of the whole file; reads what is left of it."""
        while self.read(2**20):
            pass
        return self._sha256.hexdigest()
