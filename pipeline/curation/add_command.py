"""`motionloom data add`: a column for the clips of a finished set, captions or a folder of arrays.

Names are those of clips, or the only ends of their paths. The manifest is derived from all records that are
there, again until it stays so: of people who add columns at once, also in a bucket, which has no locks, the
last to write has seen all records.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.base.records import (
    COLUMN_FILE,
    COLUMNS,
    MANIFEST_FILE,
    SPLITS,
    Caption,
    Column,
    Manifest,
)
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.captions.read import place_of
from motionloom.datasets.convert.common.files import walk_files
from motionloom.datasets.motion.npz import MAX_BYTES
from motionloom.datasets.shards.columns import Value, empty_value, write_column
from motionloom.datasets.shards.index import ClipEntry
from motionloom.datasets.shards.reader import ShardDataset, read_manifest
from motionloom.datasets.shards.sample import json_bytes, npy_bytes, require_finite
from motionloom.datasets.shards.store import LocalStore, Store, open_store, read_stored, write_stored
from motionloom.datasets.shards.tar import npy_from_bytes
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.launch.console import make_console, say

_SHOWN = 5
"""Names of each kind that are printed."""

Given = Mapping[str, tuple[Caption, ...] | Path]
"""Captions of a clip, or the file of its array, by its name."""


class Added(NamedTuple):
    """A column that was added, the names of no clip of the set, and what of the source could not be used."""

    column: Column
    gone: list[str]
    bad: list[str]


def add(place: str, source: Path, *, progress: bool = False) -> Added:
    """Add what `source` holds to the set at `place`, as a column of the name of its file or folder."""
    origin, _ = place_of(source)
    if not origin.exists():
        raise UserError(f"{origin}: no such file or folder")
    name = re.sub(r"[\W_]+", "_", origin.stem.lower(), flags=re.ASCII).strip("_")
    arrays = _arrays(origin)
    captions = Captions() if arrays else Captions.read([source])
    bad = list(captions.bad)
    given: Given = arrays or {name: row.texts for name, row in captions.rows.items() if row.texts}
    member = f"{name}.npy" if arrays else f"{name}.json"
    manifest, _ = read_manifest(open_store(place))
    held = {shard.split for shard in manifest.shards}
    splits = [ShardDataset.open(place, split, every=True) for split in SPLITS if split in held]
    is_name = re.match(r"[a-z]", name) is not None
    is_new = name not in {column.name for column in manifest.columns}
    if not is_name or (is_new and any(split.has(member).any() for split in splits)):
        why = f"its clips have {member} already" if is_name else f"'{name}' is no name"
        raise UserError(
            f"{place}: {why}; call the file what the column is to be called, such as my_{origin.name}"
        )
    named = by_clip(given, [clip for split in splits for clip in split.ids])
    if not named:
        raise UserError(f"{source}: none of its {len(given):,} names is a clip of {place}")
    used = set(named.values())
    gone = [one for one in given if one not in used]
    fps = manifest.fps

    def value(clip: ClipEntry) -> bytes | None:
        if clip.id not in named:
            return None
        found = given[named[clip.id]]
        if isinstance(found, Path):
            return _array(found)
        kept = [one for one in found if one.start < clip.frames / fps]
        bad.extend(
            f"'{one.text}' starts behind the end of clip {clip.id}" for one in found if one not in kept
        )
        return json_bytes([one.dump() for one in kept]) if kept else None

    first = given[next(iter(used))]
    empty = empty_value(member, _array(first) if isinstance(first, Path) else b"")
    column = _add(place, name, member, value, empty, len(gone), progress)
    return Added(column, gone, bad)


def by_clip(names: Iterable[str], ids: Iterable[str]) -> dict[str, str]:
    """Clip id -> the name that is its, or the only one's that ends with it (`walk-1` of `walks/walk-1`)."""
    ends: dict[str, list[str]] = defaultdict(list)
    for clip in ids:
        ends[clip.rpartition("/")[2]].append(clip)
    found = {}
    for name in names:
        clips = ends[name.rpartition("/")[2]]
        if name in clips:
            found[name] = name
        elif len(fit := [clip for clip in clips if clip.endswith(f"/{name}")]) == 1:
            found.setdefault(fit[0], name)
    return found


def _arrays(folder: Path) -> dict[str, Path]:
    """The .npy files of a folder by their paths in it, without the ending; none of a file."""
    names = walk_files(folder) if folder.is_dir() else []
    return {name.removesuffix(".npy"): folder / name for name in names if name.endswith(".npy")}


def _array(path: Path) -> bytes:
    """An array as a clip's member, float32."""
    values = np.asarray(npy_from_bytes(read_plain(path, MAX_BYTES), str(path)), np.float32)
    if not values.ndim or not values.size:
        raise UserError(f"{path}: holds no numbers; leave the file out")
    try:
        require_finite(str(path), values.reshape(len(values), -1))
    except ValueError as error:
        raise UserError(str(error)) from None
    return npy_bytes(values)


def _add(place: str, name: str, member: str, value: Value, empty: bytes, gone: int, progress: bool) -> Column:
    """Write a column beside the shards of a folder or URL, and list it in the manifest.

    `empty` stands for a clip without a value, `gone` counts values of no clip. Killed, give it again.
    """
    with _adding(place) as store:
        manifest, _ = read_manifest(store)
        if name in {one.name for one in _recorded(store, manifest)}:
            raise UserError(
                f"{place}: has a column '{name}'; remove it first, or name the file otherwise: motionloom "
                f"data add {place} {name} --remove"
            )
        with Meter("adding a column", len(manifest.shards), shown=progress) as meter:
            column = write_column(store, name, member, manifest.shards, value, empty, meter.advance)
        column = column.model_copy(update={"gone": gone})
        write_stored(store, column.file(COLUMN_FILE), column.dump())
        _publish(store)
        return column


def remove_column(place: str, name: str) -> None:
    """Take a column out of the manifest, and delete its files; `UserError` where there is none of that name.

    The record goes first: without it nobody lists the column again.
    """
    with _adding(place) as store:
        files = store.names(f"{COLUMNS}/{name}")
        if not files:
            known = ", ".join(column.name for column in read_manifest(store)[0].columns) or "there is none"
            raise UserError(f"{place}: no column '{name}'; known: {known}")
        record = f"{COLUMNS}/{name}/{COLUMN_FILE}"
        if record in files:
            store.remove(record)
        _publish(store)
        for file in sorted({*files} - {record}):
            store.remove(file)


@contextmanager
def _adding(place: str) -> Iterator[Store]:
    """The store of a place, while no conversion writes there."""
    store = open_store(place)
    if not isinstance(store, LocalStore):
        if store.place.startswith("http"):
            raise UserError(f"{place}: a web server is only read; name a folder or a bucket")
        yield store
        return
    if (store.root.parent / "started.json").exists():
        raise UserError(f"{place}: is a run's own; convert a set of its own, and read it with kind: shards")
    with folder_lock(store.root, shared=True):
        yield store


def _recorded(store: Store, manifest: Manifest) -> list[Column]:
    """The columns that have a record and are of the manifest's shards, by name."""
    names = [name for name in store.names(COLUMNS) if name.endswith(f"/{COLUMN_FILE}")]
    found = [Column.parse(parse_json(read_stored(store, name), name), store.where(name)) for name in names]
    return [column for column in found if column.fits(manifest.shards)]


def _publish(store: Store) -> None:
    """Write the manifest with all columns, until those that are there are those that it lists."""
    while True:
        manifest, _ = read_manifest(store)
        columns = _recorded(store, manifest)
        if columns == manifest.columns:
            return
        write_stored(store, MANIFEST_FILE, manifest.model_copy(update={"columns": columns}).dump())


def command(
    place: Annotated[str, typer.Argument(metavar="SHARDS", help="Folder or URL of a data set.")],
    source: Annotated[
        Path, typer.Argument(help="Captions in any form that is read, or a folder of CLIP.npy files.")
    ],
    gone: Annotated[bool, typer.Option("--remove", help="Remove the column of this name.")] = False,
) -> None:
    """A column beside the shards, such as captions or features; no shard is written again.

    It has the name of its file and travels with the set.

    Example: `motionloom data add shards captions.jsonl`

    Example: `motionloom data add s3://my-bucket/shards contacts --remove`
    """
    console = make_console()
    if gone:
        remove_column(place, str(source))
        say(console, f"{place}: column {source} is removed")
        return
    added = add(place, source, progress=console.is_terminal)
    for kind, names in (("not used", added.bad), ("no clip of the set", added.gone)):
        for name in names[:_SHOWN]:
            say(console, f"{kind}: {name}")
        if len(names) > _SHOWN:
            say(console, f"and {len(names) - _SHOWN:,} more, {kind}")
    column = added.column
    clips = sum(tar.samples for tar in column.shards)
    size = sum(tar.bytes for tar in column.shards) / 2**20
    say(console, f"{place}: {column.member} for {column.clips:,} of {clips:,} clips, {size:,.1f} MiB")


register(Command("data add", command))
