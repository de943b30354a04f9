"""A data set carried from one place to another: a folder, a bucket, or a data set on the hub.

Files that the target has with their sha256 are not sent again, so a killed copy is resumed; sent files are
compared there. A bucket knows the sha256 of what we put there, so that comparing takes a request and no byte.
The manifest goes last, and an older one is deleted first: no reader sees half a copy.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of, temporary_folder
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.base.records import (
    CLEANED_FILE,
    COLUMN_FILE,
    INDEX_FILE,
    MANIFEST_FILE,
    REMOVED_FILE,
    Manifest,
)
from motionloom.datasets.shards.card import CARD_FILE
from motionloom.datasets.shards.index import index_path
from motionloom.datasets.shards.left_out import LEFT_OUT_FILE
from motionloom.datasets.shards.reader import read_manifest
from motionloom.datasets.shards.store import LocalStore, MissingFileError, Store, open_store

_BESIDE = (CARD_FILE, LEFT_OUT_FILE, CLEANED_FILE, REMOVED_FILE)
_AT_ONCE = 16
"""Files, so that a bucket's answers, 50 ms each, are not waited for one after the other."""


class Copied(NamedTuple):
    """Files that a copy sent, and those that lay at the target already."""

    sent: int
    kept: int


def copy_dataset(source: str, target: str, *, progress: bool = False) -> Copied:
    """Copy the data set at `source` to `target`, folders or URLs; `UserError` if a byte is damaged."""
    here = open_store(source)
    there = open_store(target)
    if there.place.startswith("http"):
        raise UserError(f"{target}: a web server is only read; name a folder, s3://… or hf://datasets/…")
    manifest, digest = read_manifest(here)
    _remove_older(there, manifest, digest)
    sums = {tar.name: tar.sha256 for tar in manifest.tars}
    # Without the others of these a data set can be read; `data convert` and `data clean` go on with them. Who
    # was removed is nothing to publish, though it is hashed: names can be tried.
    needed = {*sums, INDEX_FILE}
    beside = [name for name in _BESIDE if name != REMOVED_FILE or not there.place.startswith("hf:")]
    names = [*_named(manifest), *beside, INDEX_FILE]
    sent = kept = 0
    with temporary_folder() as folder, Meter("copying", len(names) + 1, shown=progress) as meter:

        def send(name: str) -> bool | None:
            try:
                return _send_file(here, there, name, sums.get(name) or here.digest(name), folder)
            except MissingFileError:
                if name in needed:
                    raise
                return None

        with ThreadPoolExecutor(_AT_ONCE) as threads:
            for new in threads.map(send, names):
                sent += new is True
                kept += new is False
                meter.advance()
        last = _send_file(here, there, MANIFEST_FILE, digest, folder)
    return Copied(sent + last, kept + (not last))


def _remove_older(there: Store, manifest: Manifest, digest: str) -> None:
    """Delete an older manifest at the target, after the files that it alone names."""
    if there.digest(MANIFEST_FILE) in (None, digest):
        return
    old, _ = read_manifest(there)
    if old.name != manifest.name:
        raise UserError(f"{there.place}: holds data set '{old.name}', not '{manifest.name}'; name another")
    gone = sorted({*_named(old)} - {*_named(manifest)})
    for name in (*gone, *_BESIDE, MANIFEST_FILE):
        if there.digest(name) is not None:
            there.remove(name)


def _send_file(here: Store, there: Store, name: str, wanted: str | None, folder: Path) -> bool:
    """Send a file of that sha256, None if there is none, unless the target has it; compare it there; return
    whether it was sent.
    """
    source = here.where(name)
    if wanted is None:
        raise MissingFileError(f"{source}: no such file")
    if there.digest(name) == wanted:
        return False
    path = folder / name
    if isinstance(here, LocalStore):
        path = here.root / name
        if not path.is_file():
            raise MissingFileError(f"{source}: no such file")
    else:
        here.get(name, path)
    if sha256_of(path) != wanted:
        raise UserError(f"{source}: the sha256 is not the manifest's: damaged; nothing of it is copied")
    try:
        there.put(path, name, wanted)
    finally:
        if path.is_relative_to(folder):
            path.unlink()
    if there.digest(name) != wanted:
        raise UserError(f"{there.where(name)}: is not what was sent, by its sha256; give the command again")
    return True


def _named(manifest: Manifest) -> list[str]:
    """The files of shards and columns."""
    indices = [index_path(Path(shard.name)).name for shard in manifest.shards]
    about = [column.file(name) for column in manifest.columns for name in (INDEX_FILE, COLUMN_FILE)]
    return [*(tar.name for tar in manifest.tars), *indices, *about]
