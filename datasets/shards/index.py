"""Offsets of all members: one JSON index per shard, one `index.npz` for the whole dataset.

`NAME-SPLIT-000000.index` (`ShardIndex`) is JSON and stands beside its tar; its presence means the tar is
whole. It is called no `.json`, which other readers of a folder would take for the data. `index.npz` holds the
same offsets as flat arrays, one set per split (`train.frames`, ...), so that opening a million clips reads a
few large arrays and no shard. Rows follow the shards in manifest order.
Arrays, n clips of a split and M = `len(MEMBERS)`:

| array           | type          | meaning |
|-----------------|---------------|---------|
| `frames`        | int32 [n]     | T |
| `data`          | int64 [n]     | byte in the tar where the motion values start (after the .npy header) |
| `itemsize`      | uint8 [n]     | bytes per motion value: 4 or 2 |
| `held`          | uint8 [n]     | what the clip holds beside its body, by its `meta.json`: 1 hands, 2 face |
| `offsets`       | int64 [n, M]  | byte in the tar where each member starts |
| `sizes`         | uint32 [n, M] | its size; 0 = the clip has no such member |
| `id_ends`       | int64 [n]     | end of each clip's id in `id_bytes` |
| `id_bytes`      | uint8 [sum]   | ids, UTF-8, one after the other |
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_bytes
from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.records import INDEX_FILE, PRESENT_ALL, Column, Dropped, ShardInfo, Split
from motionloom.datasets.motion.npz import NpzFile, read_npy_header
from motionloom.datasets.shards.sample import MEMBERS
from motionloom.datasets.shards.store import Store
from motionloom.datasets.shards.tar import TarClip, scan_tar

_ARRAYS: dict[str, tuple[type[np.generic], int]] = {
    "frames": (np.int32, 1),
    "data": (np.int64, 1),
    "itemsize": (np.uint8, 1),
    "held": (np.uint8, 1),
    "offsets": (np.int64, 2),
    "sizes": (np.uint32, 2),
    "id_ends": (np.int64, 1),
    "id_bytes": (np.uint8, 1),
}
_MOST_ID_BYTES = 4096
"""Largest size of one clip's id."""


class ClipEntry(Config):
    """One clip of a shard: member name -> (offset, size), and where its motion values start."""

    key: str
    id: str
    source: str
    """Name of its source item in reports."""
    made_from: str
    """Digest of everything that its bytes depend on."""
    held: int
    """Bits of `ClipMeta.present`."""
    frames: int
    motion_data: int
    motion_itemsize: int
    members: dict[str, tuple[int, int]]


class Written(NamedTuple):
    """Facts of a clip that the writer knows and its tar does not."""

    id: str
    held: int
    source: str
    made_from: str


class ShardIndex(Config):
    """`NAME-SPLIT-000000.index`. `shard` is None when every clip was dropped (no tar then)."""

    fingerprint: str
    shard: ShardInfo | None
    clips: list[ClipEntry]
    dropped: list[Dropped]
    doubts: list[Dropped] = Field(default_factory=list)
    """Faults that the judge of motion has found in its clips."""
    made_on: str = ""
    """Kinds of processor on which the clips were made: last digits may differ between them."""

    @property
    def kinds(self) -> set[str]:
        """The kinds in `made_on`; empty if the index does not say."""
        return set(filter(None, self.made_on.split(", ")))


def index_path(tar: Path) -> Path:
    """The JSON index beside a tar."""
    return tar.with_name(tar.name.removesuffix(".tar") + ".index")


def clip_entries(path: Path, written: Sequence[Written]) -> list[ClipEntry]:
    """Return the index rows of a tar on disk; `written` holds further facts of its clips, in order."""
    with open_plain(path) as file:
        return entries_of(file, path, scan_tar(path), written)


def entries_of(
    file: BinaryIO, path: Path, clips: Sequence[TarClip], written: Sequence[Written]
) -> list[ClipEntry]:
    """The same of an open tar whose clips are known; `ValueError` where `written` has others."""
    entries = []
    for clip, about in zip(clips, written, strict=True):
        start, size = clip.members["motion.npy"]
        file.seek(start)
        header = read_npy_header(file, f"{path}: '{clip.key}.motion.npy'", size)
        entries.append(
            ClipEntry(
                key=clip.key,
                **about._asdict(),
                frames=header.shape[0],
                motion_data=start + header.start,
                motion_itemsize=header.dtype.itemsize,
                members=clip.members,
            )
        )
    return entries


@dataclass(frozen=True)
class SplitIndex:
    """The arrays of one split (module docstring)."""

    frames: NDArray[np.int32]
    data: NDArray[np.int64]
    itemsize: NDArray[np.uint8]
    held: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.uint32]
    id_ends: NDArray[np.int64]
    id_bytes: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.frames)

    def id(self, i: int) -> str:
        start = int(self.id_ends[i - 1]) if i else 0
        return self.id_bytes[start : int(self.id_ends[i])].tobytes().decode()

    @staticmethod
    def build(shards: Iterable[ShardIndex]) -> SplitIndex:
        """The shards of one split. Only flat arrays are kept, so a million clips fit."""
        return SplitIndex.join(map(SplitIndex.of, shards))

    @staticmethod
    def of(shard: ShardIndex) -> SplitIndex:
        """The arrays of one shard."""
        # Ids lie one after the other as bytes: an array of text takes the longest one's room for each.
        ids = [entry.id.encode() for entry in shard.clips]
        places = np.array(
            [[entry.members.get(name, (0, 0)) for name in MEMBERS] for entry in shard.clips], dtype=np.int64
        ).reshape(len(ids), len(MEMBERS), 2)
        columns = {
            "frames": [entry.frames for entry in shard.clips],
            "data": [entry.motion_data for entry in shard.clips],
            "itemsize": [entry.motion_itemsize for entry in shard.clips],
            "held": [entry.held for entry in shard.clips],
            "offsets": places[..., 0],
            "sizes": places[..., 1],
            "id_ends": np.cumsum([len(source) for source in ids]),
            "id_bytes": np.frombuffer(b"".join(ids), dtype=np.uint8),
        }
        return SplitIndex(
            **{name: np.asarray(columns[name], dtype=kind) for name, (kind, _) in _ARRAYS.items()}
        )

    @staticmethod
    def join(shards: Iterable[SplitIndex]) -> SplitIndex:
        """The arrays of several shards as one."""
        empty = SplitIndex.of(ShardIndex(fingerprint="", shard=None, clips=[], dropped=[]))
        parts = [empty, *shards]
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        before = np.cumsum([0, *(len(part.id_bytes) for part in parts[:-1])])
        joined["id_ends"] += np.repeat(before, [len(part) for part in parts])
        return SplitIndex(**joined)


def save_index(root: Path, splits: dict[Split, SplitIndex]) -> None:
    """Write `index.npz` atomically; zip entries carry a fixed date, so equal content is equal bytes."""
    arrays = {f"{split}.{name}": getattr(index, name) for split, index in splits.items() for name in _ARRAYS}
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    write_bytes(root / INDEX_FILE, content.getvalue())


def load_index(root: Path, split: Split, shards: list[ShardInfo]) -> SplitIndex:
    """The arrays of one split of a dataset folder, checked against the manifest's rows for it."""
    path = root / INDEX_FILE
    try:
        with open_plain(path) as file:
            return read_index(file, str(path), split, shards)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; convert the dataset again") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None


def read_index(file: BinaryIO, where: str, split: Split, shards: list[ShardInfo]) -> SplitIndex:
    """The arrays of one split, checked against the manifest's rows for it.

    Sizes are compared with the manifest before an array is read. Every offset is checked to lie inside its
    shard here, once for all clips, so reading a clip needs no checks.
    """
    clips = sum(shard.samples for shard in shards)
    try:
        with NpzFile(file, where) as stored:
            limits = {"id_bytes": _MOST_ID_BYTES, "offsets": 8 * len(MEMBERS), "sizes": 4 * len(MEMBERS)}
            arrays = {
                name: stored.mapped(f"{split}.{name}", limit=clips * limits.get(name, 8) + 4096)
                for name in _ARRAYS
            }
    except UserError as error:
        reason = str(error).removeprefix(f"{where}: ")
        raise UserError(f"{where}: not a readable index ({reason}); convert the dataset again") from None
    for name in ("offsets", "sizes"):  # a data set may be older than a modality that was added
        missing = len(MEMBERS) - arrays[name].shape[-1]
        if arrays[name].ndim == 2 and 0 < missing < len(MEMBERS):
            arrays[name] = np.pad(arrays[name], ((0, 0), (0, missing)))
    index = SplitIndex(**arrays)
    problem = _index_problem(index, shards)
    if problem:
        raise UserError(f"{where}: split '{split}': {problem}; convert the dataset again")
    return index


def _index_problem(index: SplitIndex, shards: list[ShardInfo]) -> str | None:
    """The first way in which an index contradicts the manifest, or None."""
    samples = np.array([shard.samples for shard in shards], dtype=np.int64)
    count = int(samples.sum())
    for name, (kind, rank) in _ARRAYS.items():
        values = getattr(index, name)
        if values.dtype != kind or values.ndim != rank or (name != "id_bytes" and len(values) != count):
            return f"array '{name}' is {values.dtype} {list(values.shape)}, the manifest has {count} clips"
    if (index.held > PRESENT_ALL).any():
        return f"array 'held' has values above {PRESENT_ALL}"
    if index.offsets.shape[1] != len(MEMBERS) or index.sizes.shape[1] != len(MEMBERS):
        return f"offsets are not for {len(MEMBERS)} members"
    if count == 0:
        return None
    ends = index.id_ends
    if ends[0] < 0 or (np.diff(ends) < 0).any() or ends[-1] != len(index.id_bytes):
        return "the clip ids are damaged"
    if index.id_bytes.max(initial=0) > 127:  # of letters beyond ASCII, none may be cut in two
        begins = index.id_bytes[ends[:-1][ends[:-1] < ends[-1]]]
        try:
            index.id_bytes.tobytes().decode()
        except UnicodeDecodeError:
            return "the clip ids are damaged"
        if (begins >> 6 == 0b10).any():
            return "the clip ids are damaged"
    if (samples < 1).any():
        return "a shard of the manifest has no samples"
    # Compared once for all clips, so that reading one needs no checks.
    firsts = np.cumsum(samples) - samples
    for wrong, message in (
        (_wrong_frames(index, shards, firsts), "has other frame counts than the manifest says"),
        (_outside(index, shards, firsts), "has members outside the file"),
        ((index.itemsize != 2) & (index.itemsize != 4), "holds motion that is neither float32 nor float16"),
    ):
        if wrong.any():
            at = int(wrong.argmax())
            shard = at if len(wrong) == len(shards) else int(np.searchsorted(firsts, at, side="right")) - 1
            return f"shard {shards[shard].name} {message}"
    return None


def _wrong_frames(index: SplitIndex, shards: list[ShardInfo], firsts: NDArray[np.int64]) -> NDArray[np.bool_]:
    totals = np.add.reduceat(index.frames.astype(np.int64), firsts)
    least = np.minimum.reduceat(index.frames, firsts)
    stated = np.array([shard.frames for shard in shards], dtype=np.int64)
    wrong: NDArray[np.bool_] = (totals != stated) | (least < 1)
    return wrong


def _outside(index: SplitIndex, shards: list[ShardInfo], firsts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each shard whether a member or motion lies outside the file; by columns, to save memory."""
    size = np.array([shard.bytes for shard in shards], dtype=np.int64)
    wrong = np.zeros(len(shards), dtype=np.bool_)
    for column in range(len(MEMBERS)):
        start = index.offsets[:, column]
        lowest = np.minimum.reduceat(start, firsts)
        # No int64 sum can wrap here: an offset beyond the file is refused by the first comparison already.
        wrong |= (lowest < 0) | (np.maximum.reduceat(start, firsts) > size)
        wrong |= np.maximum.reduceat(start + index.sizes[:, column], firsts) > size
    wrong |= (np.minimum.reduceat(index.data, firsts) < 0) | (np.maximum.reduceat(index.data, firsts) > size)
    return wrong


class SideColumn:
    """A column beside the shards (`columns.py`) in one split; its rows are those of the split's index.

    `read` takes shard, start and size.
    """

    def __init__(
        self, column: Column, store: Store, split: Split, read: Callable[[int, int, int], bytes]
    ) -> None:
        self.column = column
        self._read = read
        where = store.where(column.file(INDEX_FILE))
        tars = column.tars(split)
        ends = np.repeat([tar.bytes for tar in tars], [tar.samples for tar in tars])
        limit = 8 * len(ends) + 4096
        with store.open_index(column.index, column.file(INDEX_FILE)) as file, NpzFile(file, where) as stored:
            self._offsets = offsets = stored.array(f"{split}.offsets", limit=limit)
            self.sizes = stored.array(f"{split}.sizes", limit=limit)
        fits = offsets.dtype == np.int64 and self.sizes.dtype == np.uint32
        # Compared once for all clips, so that reading one needs no checks.
        if not (fits and offsets.shape == self.sizes.shape == ends.shape) or (
            ((offsets < 0) | (offsets > ends) | (offsets + self.sizes > ends)).any()
        ):
            raise UserError(
                f"{where}: does not fit its tars; remove column '{column.name}', and add it again"
            )

    def value(self, shard: int, row: int) -> bytes:
        """The value of a clip; empty where it has none."""
        size = int(self.sizes[row])
        return self._read(shard, int(self._offsets[row]), size) if size else b""
