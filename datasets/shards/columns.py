"""Columns that are added to a finished set: captions, features, contacts, embeddings.

`columns/NAME/` holds a tar beside each shard, of its name, with its keys in its order and one member each,
`NAME.json` (captions) or `NAME.npy` (an array). A clip without a value has an empty one, so that readers may
zip both. `index.npz` holds `offsets` and `sizes` of each split's clips (0: no value), `column.json` the
record. No shard is written again.

The manifest lists the records. A conversion that changes shards carries columns over by the clips' keys.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from motionloom.datasets.base.files import sha256_of, temporary_folder, write_bytes
from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.records import (
    COLUMN_FILE,
    COLUMNS,
    INDEX_FILE,
    SPLITS,
    Column,
    ShardInfo,
    beside,
)
from motionloom.datasets.shards.index import ClipEntry, ShardIndex, index_path
from motionloom.datasets.shards.sample import npy_bytes
from motionloom.datasets.shards.store import LocalStore, Store, read_stored, write_stored
from motionloom.datasets.shards.tar import npy_from_bytes, scan_tar

Value = Callable[[ClipEntry], bytes | None]
"""The value of a clip, as its member holds it; None where it has none."""


def carry_over(root: Path, aside: Path, shards: Sequence[ShardInfo]) -> list[Column]:
    """The columns of a folder whose shards may have changed, written again where they did, by clips' keys.

    What a column was before lies in the folder `aside` until the caller removes that; killed in between, the
    values are taken from there.
    """
    store = LocalStore(root)
    names = {path.name for folder in (root, aside) for path in (folder / COLUMNS).glob("*/")}
    found = []
    for name in sorted(names):
        record = root / COLUMNS / name / COLUMN_FILE
        column = Column.load_json(record) if record.is_file() else None
        if column is None or not column.fits(shards):
            old = aside / COLUMNS / name
            if old.exists():
                shutil.rmtree(root / COLUMNS / name, ignore_errors=True)
            elif column is not None:
                old.parent.mkdir(parents=True, exist_ok=True)
                (root / COLUMNS / name).replace(old)
            if not (old / COLUMN_FILE).is_file():  # it was being added, or removed
                shutil.rmtree(root / COLUMNS / name)
                continue
            column = _rewritten(store, Column.load_json(old / COLUMN_FILE), old, shards)
            write_stored(store, column.file(COLUMN_FILE), column.dump())
        found.append(column)
    return found


def drop_columns(root: Path, shards: Sequence[ShardInfo]) -> None:
    """Forget the columns of other shards than these, where their tars are not at hand."""
    for record in root.glob(f"{COLUMNS}/*/{COLUMN_FILE}"):
        if not Column.load_json(record).fits(shards):
            shutil.rmtree(record.parent)


def write_column(
    store: Store,
    name: str,
    member: str,
    shards: Sequence[ShardInfo],
    value: Value,
    empty: bytes,
    done: Callable[[], object] = lambda: None,
) -> Column:
    """Write the tars of a column and its index."""
    from webdataset.writer import TarWriter  # imports torch: two seconds

    tars = []
    offsets: dict[str, list[int]] = {split: [] for split in SPLITS}
    sizes: dict[str, list[int]] = {split: [] for split in SPLITS}
    with temporary_folder() as folder:
        path = folder / "column"
        for shard in shards:
            about = index_path(Path(shard.name)).name
            index = ShardIndex.parse(parse_json(read_stored(store, about), about), store.where(about))
            held = []
            with path.open("wb") as file, TarWriter(file, encoder=False, user="", group="", mtime=0) as tar:
                for clip in index.clips:
                    raw = value(clip)
                    held.append(0 if raw is None else len(raw))
                    tar.write({"__key__": clip.key, member: empty if raw is None else raw})
            sizes[shard.split] += held
            offsets[shard.split] += [clip.members[member][0] for clip in scan_tar(path, column=member)]
            tars.append(
                shard.model_copy(
                    update={
                        "name": f"{COLUMNS}/{name}/{shard.name}",
                        "bytes": path.stat().st_size,
                        "sha256": sha256_of(path),
                    }
                )
            )
            store.put(path, tars[-1].name, tars[-1].sha256)
            done()
        content = io.BytesIO()
        arrays = {f"{split}.offsets": np.array(offsets[split], np.int64) for split in SPLITS}
        arrays |= {f"{split}.sizes": np.array(sizes[split], np.uint32) for split in SPLITS}
        np.savez(content, allow_pickle=False, **arrays)
        write_bytes(path, content.getvalue())
        index_sum = sha256_of(path)
        store.put(path, f"{COLUMNS}/{name}/{INDEX_FILE}", index_sum)
        return Column(
            name=name,
            member=member,
            shards=tars,
            beside=beside(shards),
            index=index_sum,
            clips=sum(size > 0 for split in SPLITS for size in sizes[split]),
        )


def _rewritten(store: Store, before: Column, old: Path, shards: Sequence[ShardInfo]) -> Column:
    """A column for other shards than before, whose tars lie in `old`; values of clips that are gone go."""
    member = before.member
    places: dict[str, tuple[Path, int, int]] = {}
    for tar in before.shards:
        path = old / Path(tar.name).name
        places |= {clip.key: (path, *clip.members[member]) for clip in scan_tar(path, column=member)}
    empty = empty_value(member, _read(*next(iter(places.values()))))

    def value(clip: ClipEntry) -> bytes | None:
        raw = _read(*places[clip.key]) if clip.key in places else empty
        return None if len(raw) <= len(empty) else raw

    column = write_column(store, before.name, member, shards, value, empty)
    return column.model_copy(update={"gone": before.gone + max(0, before.clips - column.clips)})


def _read(path: Path, start: int, size: int) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read(size)


def empty_value(member: str, like: bytes) -> bytes:
    """What stands for a missing value beside others `like` this: no captions, or an array without rows."""
    if member.endswith(".json"):
        return b"[]"
    return npy_bytes(np.zeros((0, *npy_from_bytes(like, member).shape[1:]), np.float32))
