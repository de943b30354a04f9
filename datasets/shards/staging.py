"""Conversion straight into a bucket: a folder of this machine stands for it while shards are made.

Each shard goes there when it is done, its index behind it, and leaves the folder; a part's record comes when
all of its shards are there. What is finished is known by these: no lock is needed, and a part that is made
twice puts the same bytes under the same names. `join` lists the records and puts what belongs to the whole
set, `manifest.json` last.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of, temporary_folder
from motionloom.datasets.base.records import (
    CLEANED_FILE,
    COLUMN_FILE,
    INDEX_FILE,
    MANIFEST_FILE,
    REMOVED_FILE,
)
from motionloom.datasets.shards.store import LocalStore, RemoteStore, open_store

_FETCHED = re.compile(
    rf"{MANIFEST_FILE}|{INDEX_FILE}|{CLEANED_FILE}|{REMOVED_FILE}|joint_maps/.*|\.parts/.*|.*/{COLUMN_FILE}"
)
"""What a conversion or a join reads of an earlier one, beside the shards' indices."""


@contextmanager
def staged(place: str | Path) -> Iterator[tuple[Path, RemoteStore | None]]:
    """The folder to work in: the place itself, or one that stands for a bucket, with its store."""
    store = open_store(place)
    if isinstance(store, LocalStore):
        yield store.root, None
        return
    if store.place.startswith("http"):
        raise UserError(f"{place}: a web server is only read; name a folder or a bucket")
    with temporary_folder() as folder:
        out = folder / "shards"
        out.mkdir()
        for name in filter(_FETCHED.fullmatch, store.names("")):
            store.get(name, out / name)
        try:
            yield out, store
        except UserError as error:
            raise UserError(str(error).replace(str(out), store.place)) from None


def put(store: RemoteStore, out: Path, *names: str) -> None:
    """Put those of some files of the folder that are there, in this order."""
    for name in names:
        path = out / name
        if path.is_file() and store.digest(name) != (digest := sha256_of(path)):
            store.put(path, name, digest)
