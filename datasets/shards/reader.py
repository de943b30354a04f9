"""`ShardDataset`: random access to the clips of one split, in a folder or on a server.

Clips that the manifest excludes (`motionloom data clean`) are skipped and have no number.

Opening reads `manifest.json` and the split's arrays of `index.npz`, and, in a folder, looks at the sizes of
the shard files; no shard is opened before one of its clips is asked for. What is asked for, and no more, is
then read from the tar (of the folder, or of the local cache of a server's shards) by one `pread`, so the page
cache is the only cache and every loader process shares it. To map a tar takes more calls than to read from
it, and a process that reads mapped bytes of a file that was cut short dies.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import resource
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache, cached_property
from itertools import accumulate
from pathlib import Path
from threading import Semaphore, Thread
from typing import ClassVar
from weakref import ReferenceType, ref

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.records import (
    INDEX_FILE,
    MANIFEST_FILE,
    SCHEMA_VERSION,
    SPLITS,
    Caption,
    ClipMeta,
    Manifest,
    ShardInfo,
    Split,
)
from motionloom.datasets.base.register import discover
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.clips import ClipDataset, Source
from motionloom.datasets.shards.index import SideColumn, read_index
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.sample import MEMBERS, captions_from_json, meta_from_json
from motionloom.datasets.shards.store import LocalStore, MissingFileError, Store, open_store
from motionloom.datasets.shards.tar import npy_from_bytes

_SHARD_NAME = re.compile(r"[A-Za-z0-9_-]+-(?:train|val|test)-(\d{6,})\.tar")

_SPARE = 512
"""Descriptors of a process that are not for shards: sockets, logs, loaders."""
_MOST = 2**16
"""Descriptors that are asked for at most: for 16 million clips in shards of 256."""


FETCHING = "shard ahead"
"""Name of threads that download a shard."""
_DOWNLOADS = Semaphore(8)
"""Downloads of one process at a time, ahead of their reading."""
_ASKED = 256
"""Shards that were asked for last, and are not asked for again."""


@cache
def open_shards() -> int:
    """Shards that this process holds open at a time, of all data sets: what its limit of descriptors allows
    (1,024 as a rule), once that is raised to the one that the system sets.
    """
    own, hard = (
        _MOST if limit == resource.RLIM_INFINITY else limit
        for limit in resource.getrlimit(resource.RLIMIT_NOFILE)
    )
    wanted = max(own, min(hard, _MOST))
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (OSError, ValueError):  # macOS says "without a limit" and gives 10,240
        wanted = own
    return max(wanted - _SPARE, wanted // 2)


def load_manifest(root: Path) -> Manifest:
    """The manifest of a dataset folder; `UserError` when unfinished, of another version or odd."""
    return read_manifest(LocalStore(root))[0]


def read_manifest(store: Store, digest: str | None = None) -> tuple[Manifest, str]:
    """(manifest, its sha256). With `digest` it must still be that one."""
    where = store.where(MANIFEST_FILE)
    try:
        raw = store.read_manifest(digest)
    except MissingFileError:
        raise UserError(
            f"{store.place}: no {MANIFEST_FILE}, so the conversion is unfinished or this is no dataset; "
            f"convert it, or join its parts (data join)"
        ) from None
    manifest = Manifest.parse(parse_json(raw, where), where)
    if manifest.schema_version != SCHEMA_VERSION:
        raise UserError(
            f"{where}: schema version {manifest.schema_version}, not {SCHEMA_VERSION}: of another release; "
            f"give the command that made it again (this folder will do)"
        )
    for shard in manifest.shards:
        if not _SHARD_NAME.fullmatch(shard.name) or f"-{shard.split}-" not in shard.name:
            raise UserError(f"{where}: '{shard.name}' is not the name of a shard of split '{shard.split}'")
    for column in manifest.columns:
        if not column.fits(manifest.shards):
            raise UserError(
                f"{where}: column '{column.name}' is of other shards; remove it, and add it again"
            )
    return manifest, hashlib.sha256(raw).hexdigest()


def manifest_layout(manifest: Manifest) -> MotionLayout:
    """The layout a manifest describes."""
    return MotionLayout.named(manifest.layout, fps=manifest.fps, family=manifest.family)


class _Descriptor:
    """An open file; closed when nobody reads it any more, so that another thread may let go of it."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __del__(self) -> None:
        os.close(self.number)


class OpenShards:
    """Reads pieces of files of this machine, of which the least recently used are closed."""

    _recent: ClassVar[OrderedDict[tuple[ReferenceType[OpenShards], int], None]] = OrderedDict()
    """Data set and number of each shard that is open, in the order of their use."""

    def __init__(self, store: Store, shards: list[ShardInfo], room: int = 0) -> None:
        self.files: OrderedDict[int, _Descriptor] = OrderedDict()
        self._self = ref(self)
        self._store = store
        self._shards = shards
        self._coming: deque[int] = deque(maxlen=_ASKED)
        self._most = open_shards()
        if room:  # a deleted file takes disk space while it is open: at most an eighth of the cache may
            self._most = max(1, min(self._most, room // (8 * max(shard.bytes for shard in shards))))

    def fetch(self, shards: Sequence[int]) -> None:
        """Begin to download the shards of a server that are not open; what fails is tried again by `read`."""
        for shard in shards:
            if shard not in self.files and shard not in self._coming:
                self._coming.append(shard)
                Thread(target=self._fetch, args=(shard,), name=FETCHING, daemon=True).start()

    def _fetch(self, shard: int) -> None:
        with _DOWNLOADS, suppress(UserError):
            os.close(self._store.open_shard(self._shards[shard]))

    def read(self, shard: int, start: int, size: int) -> bytes:
        """Return `size` bytes of a shard from `start` on; `UserError` if it is shorter or cannot be read."""
        info = self._shards[shard]
        file = self.files.pop(shard, None) or _Descriptor(self._store.open_shard(info))
        self._recent.pop((self._self, shard), None)
        # Back as the one used last.
        self.files[shard] = file
        self._recent[self._self, shard] = None
        while len(self.files) > self._most:
            self._recent.pop((self._self, self.files.popitem(last=False)[0]), None)
        while len(self._recent) > open_shards():
            (other, number), _ = self._recent.popitem(last=False)
            if (owner := other()) is not None:
                owner.files.pop(number, None)
        try:
            found = os.pread(file.number, size, start)
        except OSError as error:
            raise UserError(f"{self._store.where(info.name)}: cannot be read ({error.strerror})") from None
        if len(found) != size:
            raise UserError(
                f"{self._store.where(info.name)}: ends before byte {start + size} of the manifest's "
                f"{info.bytes}: truncated while in use"
            )
        return found


class ShardDataset:
    """The clips of one split, in shard order (already shuffled). Cheap to pickle into loader workers."""

    def __init__(
        self,
        store: Store,
        split: Split,
        manifest: Manifest,
        digest: str,
        reading: Reading,
        every: bool = False,
    ) -> None:
        self.where = store.place
        self.split: Split = split
        self.manifest = manifest
        self.layout = manifest_layout(manifest)
        self.reading = reading
        self._digest = digest
        self._store = store
        self._shards = [shard for shard in manifest.shards if shard.split == split]
        self._first = list(accumulate((shard.samples for shard in self._shards), initial=0))
        try:
            with store.open_index(digest) as file:
                self._index = read_index(file, store.where(INDEX_FILE), split, self._shards)
        except MissingFileError as error:
            raise UserError(f"{error}; convert the dataset again") from None
        self.every = every
        # The index keeps all rows, since offsets and shards count them; what is excluded is never numbered.
        self._rows = np.arange(len(self._index))
        if manifest.excluded and not every:
            kept = [self._index.id(row) not in manifest.excluded for row in self._rows.tolist()]
            self._rows = self._rows[np.array(kept, dtype=np.bool_)]
        room = 0 if isinstance(store, LocalStore) else reading.cache.limit
        self._access = OpenShards(store, self._shards, room)
        self._columns = [
            SideColumn(column, store, split, OpenShards(store, column.tars(split), room).read)
            for column in manifest.columns
        ]

    @staticmethod
    def open(
        root: Path | str, split: str, *, reading: Reading | None = None, every: bool = False
    ) -> ShardDataset:
        """Open one split of a folder or URL (`file:`, `http:`, `https:`, `s3:`); `every` clip of it, or all
        that the manifest does not exclude.

        In a folder every shard's size is checked; on a server a shard is checked when it is first read
        (`reading` says how).
        """
        reading = reading or Reading()
        known = next((name for name in SPLITS if name == split), None)
        if known is None:
            raise UserError(f"no split '{split}'; known: {', '.join(SPLITS)}")
        store = open_store(root, reading.cache)
        manifest, digest = read_manifest(store)
        shards = [shard for shard in manifest.shards if shard.split == known]
        if not shards:
            raise UserError(f"{store.place}: split '{split}' has no clips")
        if isinstance(store, LocalStore):
            for tar in manifest.tars:
                if tar.split == known:
                    require_intact(LocalShard(store.root / tar.name, tar), content=False)
        dataset = ShardDataset(store, known, manifest, digest, reading, every)
        dataset._check_motion_sizes()
        return dataset

    def __len__(self) -> int:
        return len(self._rows)

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        return self._index.frames[self._rows].astype(np.int64)

    @cached_property
    def present(self) -> NDArray[np.uint8]:
        return self._index.held[self._rows]

    @cached_property
    def ids(self) -> list[str]:
        return [self._index.id(row) for row in self._rows.tolist()]

    def has(self, member: str) -> NDArray[np.bool_]:
        held = np.zeros(len(self._index), dtype=np.bool_)
        if member in MEMBERS:
            held |= self._index.sizes[:, MEMBERS.index(member)] > 0
        for side in self._columns:
            if side.column.feeds(member):
                held |= side.sizes > 0
        return held[self._rows]

    def motion(self, i: int, first: int = 0, end: int | None = None) -> NDArray[np.float32]:
        """Features of clip `i`, [T, D], or of its frames `first .. end`; read-only if float32 is stored."""
        index = self._index
        row = self._row(i)
        first, end, _ = slice(first, end).indices(int(index.frames[row]))
        width = self.layout.dim * int(index.itemsize[row])
        start = int(index.data[row]) + first * width
        raw = self._access.read(self._shard_of(row), start, max(end - first, 0) * width)
        kind = np.float32 if index.itemsize[row] == 4 else np.float16
        return np.frombuffer(raw, kind).reshape(-1, self.layout.dim).astype(np.float32, copy=False)

    def meta(self, i: int) -> ClipMeta:
        return meta_from_json(self._member(i, "meta.json"), self._where(i, "meta.json"))

    def texts(self, i: int) -> list[Caption]:
        return self._captions(i, "texts.json")

    def face_texts(self, i: int) -> list[Caption]:
        return self._captions(i, "face_texts.json")

    def array(self, i: int, member: str) -> NDArray[np.float32] | None:
        for raw in self._values(i, member):
            return npy_from_bytes(raw, self._where(i, member)).astype(np.float32)
        return None

    def wav(self, i: int) -> tuple[NDArray[np.float32], int] | None:
        raw = self._member(i, "audio.flac")
        if not raw:
            return None
        import soundfile  # only data with sound pays for the import

        try:
            signal, rate = soundfile.read(io.BytesIO(raw), dtype="float32")
        except soundfile.LibsndfileError as error:
            raise UserError(f"{self._where(i, 'audio.flac')}: not readable sound ({error})") from None
        return signal, int(rate)

    def _captions(self, i: int, member: str) -> list[Caption]:
        where = self._where(i, member)
        return [one for raw in self._values(i, member) for one in captions_from_json(raw, where)]

    def sources(self, clips: NDArray[np.int64] | None = None) -> tuple[Source, ...]:
        """One source: `clips` (all when None), with their shards if the order is the streamed one."""
        count = len(self) if clips is None else len(clips)
        if self.reading.order == "global":
            return (Source(0, count, name=self.where),)
        shards = np.repeat(
            np.arange(len(self._shards), dtype=np.int32), [shard.samples for shard in self._shards]
        )
        shards = shards[self._rows if clips is None else self._rows[clips]]
        return (Source(0, count, shards=shards, group=self.reading.shards_per_group, name=self.where),)

    def fetch(self, clips: NDArray[np.int64]) -> None:
        if not isinstance(self._store, LocalStore):
            shards = np.searchsorted(self._first, self._rows[clips], side="right") - 1
            self._access.fetch(list(dict.fromkeys(shards.tolist())))

    def parts(self) -> list[tuple[ClipDataset, float]]:
        return [(self, 1.0)]

    def _values(self, i: int, member: str) -> Iterator[bytes]:
        """The clip's own value of a member, and those of the columns that feed it, where there are any."""
        if member in MEMBERS and (raw := self._member(i, member)):
            yield raw
        row = self._row(i)
        for side in self._columns:
            if side.column.feeds(member) and (raw := side.value(self._shard_of(row), row)):
                yield raw

    def _member(self, i: int, member: str) -> bytes:
        column = MEMBERS.index(member)
        row = self._row(i)
        size = int(self._index.sizes[row, column])
        if size == 0:
            return b""
        return self._access.read(self._shard_of(row), int(self._index.offsets[row, column]), size)

    def _row(self, i: int) -> int:
        """Return the row of clip `i` in the index, which counts excluded clips too."""
        if not 0 <= i < len(self._rows):
            raise IndexError(f"clip {i} of {len(self)}")
        return int(self._rows[i])

    def _shard_of(self, row: int) -> int:
        return bisect_right(self._first, row) - 1

    def _where(self, i: int, member: str) -> str:
        return self._place(self._row(i), member)

    def _place(self, row: int, member: str) -> str:
        name = self._shards[self._shard_of(row)].name
        return f"{self._store.where(name)}: clip '{self._index.id(row)}': {member}"

    def _check_motion_sizes(self) -> None:
        """Every motion fills its member exactly, so no later read can leave the file or mix two clips."""
        index = self._index
        column = MEMBERS.index("motion.npy")
        end = index.offsets[:, column] + index.sizes[:, column]
        size = index.frames.astype(np.int64) * self.layout.dim * index.itemsize
        bad = np.flatnonzero((index.data + size != end) | (index.data < index.offsets[:, column]))
        if len(bad):
            where = self._place(int(bad[0]), "motion.npy")
            raise UserError(f"{where}: not {self.layout.dim} columns wide as layout {self.layout.name} wants")

    def __getstate__(self) -> tuple[str, Split, str, Reading, bool]:
        return self._store.place, self.split, self._digest, self.reading, self.every

    def __setstate__(self, state: tuple[str, Split, str, Reading, bool]) -> None:
        discover()  # a worker may not have met the members of other packages' modalities
        place, split, digest, reading, every = state
        store = open_store(place, reading.cache)
        manifest, _ = read_manifest(store, digest)
        ShardDataset.__init__(self, store, split, manifest, digest, reading, every)
