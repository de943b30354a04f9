"""`ShardDataset`: random access to the clips of one split, straight from the tar files.

Opening reads `manifest.json` and the split's arrays of `index.npz`, and looks at the sizes of the shard
files; no shard is opened before one of its clips is asked for. A motion is then a view into the memory-mapped
tar, so the page cache is the only cache and every loader process shares it.
"""

from __future__ import annotations

import io
import json
import mmap
import re
from bisect import bisect_right
from collections import OrderedDict
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import SCHEMA_VERSION, Caption, ClipMeta, Manifest, Split, UserError
from motionloom.datasets.shards.files import sha256_of
from motionloom.datasets.shards.index import MANIFEST_FILE, SPLITS, SplitIndex, load_index
from motionloom.datasets.shards.sample import MEMBERS, captions_from_json
from motionloom.datasets.shards.tar import read_npy_header

OPEN_SHARDS = 256
"""Shards mapped at a time in one process; the least recently used is let go."""

_SHARD_NAME = re.compile(r"[A-Za-z0-9_-]+-(?:train|val|test)-(\d{6,})\.tar")


def load_manifest(root: Path) -> Manifest:
    """The manifest of a dataset folder; `UserError` when unfinished, of another version or odd."""
    path = root / MANIFEST_FILE
    if not path.exists():
        raise UserError(
            f"{root}: no {MANIFEST_FILE}, so the conversion is unfinished or this is no dataset; convert it"
        )
    manifest = Manifest.load_json(path)
    if manifest.schema_version != SCHEMA_VERSION:
        raise UserError(
            f"{path}: schema version {manifest.schema_version}, not {SCHEMA_VERSION}; convert again"
        )
    for shard in manifest.shards:
        if not _SHARD_NAME.fullmatch(shard.name) or f"-{shard.split}-" not in shard.name:
            raise UserError(f"{path}: '{shard.name}' is not the name of a shard of split '{shard.split}'")
    return manifest


def manifest_layout(manifest: Manifest) -> MotionLayout:
    """The layout a manifest describes."""
    return MotionLayout.named(manifest.layout, fps=manifest.fps, family=manifest.family)


class ShardDataset:
    """The clips of one split, in shard order (already shuffled). Cheap to pickle into loader workers."""

    def __init__(self, root: Path, split: Split, manifest: Manifest, index: SplitIndex) -> None:
        self.root = root
        self.split: Split = split
        self.manifest = manifest
        self.layout = manifest_layout(manifest)
        self._index = index
        self._shards = [shard for shard in manifest.shards if shard.split == split]
        self._first = list(accumulate((shard.samples for shard in self._shards), initial=0))
        self._maps: OrderedDict[int, mmap.mmap] = OrderedDict()

    @staticmethod
    def open(
        root: Path | str, split: str, *, expect: MotionLayout | None = None, verify: bool = False
    ) -> ShardDataset:
        """Open one split. `expect` refuses another layout, family or fps; `verify` checks sha256."""
        root = Path(root)
        known = next((name for name in SPLITS if name == split), None)
        if known is None:
            raise UserError(f"no split '{split}'; known: {', '.join(SPLITS)}")
        manifest = load_manifest(root)
        if expect is not None:
            require_layout(manifest_layout(manifest), expect, str(root))
        shards = [shard for shard in manifest.shards if shard.split == known]
        if not shards:
            raise UserError(f"{root}: split '{split}' has no clips")
        for shard in shards:
            path = root / shard.name
            try:
                size = path.stat().st_size
            except OSError:
                raise UserError(f"{path}: the shard is missing; copy it back or convert again") from None
            if size != shard.bytes:
                raise UserError(
                    f"{path}: {size} bytes, the manifest says {shard.bytes}: truncated or changed; "
                    f"copy it back or convert again"
                )
            if verify and sha256_of(path) != shard.sha256:
                raise UserError(
                    f"{path}: the sha256 is not the manifest's: damaged; copy it back or convert again"
                )
        index = load_index(root, known, shards)
        dataset = ShardDataset(root, known, manifest, index)
        dataset._check_motion_sizes()
        return dataset

    def __len__(self) -> int:
        return len(self._index)

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """T of every clip, [n]."""
        return self._index.frames.astype(np.int64)

    @cached_property
    def ids(self) -> list[str]:
        """Source id of every clip."""
        return [self._index.id(i) for i in range(len(self))]

    def has(self, member: str) -> NDArray[np.bool_]:
        """Which clips hold a member such as `texts.json`, [n], without reading them."""
        return self._index.sizes[:, MEMBERS.index(member)] > 0

    def motion(self, i: int) -> NDArray[np.float32]:
        """Features of clip `i`, [T, D]: a read-only view into the tar (a copy if stored as float16)."""
        shard = self._shard_of(i)
        index = self._index
        shape, start = (int(index.frames[i]), self.layout.dim), int(index.data[i])
        if index.itemsize[i] == 4:
            return np.ndarray(shape, np.float32, self._map(shard), start)
        return np.ndarray(shape, np.float16, self._map(shard), start).astype(np.float32)

    def meta(self, i: int) -> ClipMeta:
        """Metadata of clip `i`."""
        where = self._where(i, "meta.json")
        try:
            data = json.loads(self._member(i, "meta.json"))
        except ValueError as error:
            raise UserError(f"{where}: not valid JSON ({error})") from None
        return ClipMeta.parse(data, where)

    def texts(self, i: int) -> list[Caption]:
        """Captions of clip `i`; empty when it has none."""
        return self._captions(i, "texts.json")

    def face_texts(self, i: int) -> list[Caption]:
        """Captions about the face of clip `i`."""
        return self._captions(i, "face_texts.json")

    def audio(self, i: int) -> NDArray[np.float32] | None:
        """Audio features of clip `i`, [T_audio, 438], if it has any."""
        raw = self._member(i, "audio.npy")
        if not raw:
            return None
        where = self._where(i, "audio.npy")
        header = read_npy_header(io.BytesIO(raw), where)
        if header.data + int(np.prod(header.shape)) * header.dtype.itemsize != len(raw):
            raise UserError(f"{where}: the array is cut short")
        return np.frombuffer(raw, header.dtype, offset=header.data).reshape(header.shape).astype(np.float32)

    def wav(self, i: int) -> tuple[NDArray[np.float32], int] | None:
        """Sound of clip `i`: (mono samples [S], rate in Hz), if it has any."""
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
        raw = self._member(i, member)
        return captions_from_json(raw, self._where(i, member)) if raw else []

    def _member(self, i: int, member: str) -> bytes:
        column = MEMBERS.index(member)
        size = int(self._index.sizes[i, column])
        if size == 0:
            return b""
        start = int(self._index.offsets[i, column])
        return self._map(self._shard_of(i))[start : start + size]

    def _shard_of(self, i: int) -> int:
        if not 0 <= i < self._first[-1]:
            raise IndexError(f"clip {i} of {len(self)}")
        return bisect_right(self._first, i) - 1

    def _where(self, i: int, member: str) -> str:
        shard = self._shard_of(i)
        name = self._shards[shard].name
        number = name.removesuffix(".tar").rpartition("-")[2]
        return f"{self.root / name}: '{number}-{i - self._first[shard]:06d}.{member}'"

    def _map(self, shard: int) -> mmap.mmap:
        """The mapped tar. Views keep a dropped map alive until they go, so letting go is always safe."""
        found = self._maps.get(shard)
        if found is not None:
            self._maps.move_to_end(shard)
            return found
        info = self._shards[shard]
        path = self.root / info.name
        try:
            with path.open("rb") as file:
                found = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: cannot be read ({error})") from None
        if len(found) != info.bytes:
            raise UserError(
                f"{path}: {len(found)} bytes, the manifest says {info.bytes}: truncated while in use"
            )
        self._maps[shard] = found
        if len(self._maps) > OPEN_SHARDS:
            self._maps.popitem(last=False)
        return found

    def _check_motion_sizes(self) -> None:
        """Every motion fills its member exactly, so no later read can leave the file or mix two clips."""
        index, column = self._index, MEMBERS.index("motion.npy")
        end = index.offsets[:, column] + index.sizes[:, column]
        size = index.frames.astype(np.int64) * self.layout.dim * index.itemsize
        bad = np.flatnonzero((index.data + size != end) | (index.data < index.offsets[:, column]))
        if len(bad):
            where = self._where(int(bad[0]), "motion.npy")
            raise UserError(f"{where}: not {self.layout.dim} columns wide as layout {self.layout.name} wants")

    def __getstate__(self) -> tuple[Path, Split]:
        return self.root, self.split

    def __setstate__(self, state: tuple[Path, Split]) -> None:
        root, split = state
        manifest = load_manifest(root)
        shards = [shard for shard in manifest.shards if shard.split == split]
        ShardDataset.__init__(self, root, split, manifest, load_index(root, split, shards))


def require_layout(found: MotionLayout, wanted: MotionLayout, where: str) -> None:
    """`UserError` naming both when data does not have the layout, family and frame rate a config expects."""
    have = (found.name, found.family, found.fps)
    want = (wanted.name, wanted.family, wanted.fps)
    if have != want:
        raise UserError(
            f"{where}: holds layout {have[0]} ({have[1]}, {have[2]:g} fps), the config expects "
            f"{want[0]} ({want[1]}, {want[2]:g} fps); convert the data again or change the config"
        )
