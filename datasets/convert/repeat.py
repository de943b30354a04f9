"""A conversion given again: where neither its source nor its shards have changed, nothing is planned.

A finished set notes the digest of size, times and inode of all that it was made from and of what was made.
With another file, setting or release the digest is another, and the conversion plans anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from motionloom import datasets
from motionloom.datasets.base.files import state_of, write_text
from motionloom.datasets.convert.captions.read import place_of
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter
from motionloom.datasets.convert.common.files import walk

_NOTE = ".finished"
_NO_PART = (_NOTE, ".sources.json", ".checked.json", ".lock", ".html", ".pyc")
"""Endings of notes, and of pages for people."""


def state_of_source(kind: type[Converter[Any, Any]], config: ConvertConfig, out: Path) -> str:
    """The digest of all that a conversion into `out` reads, to be taken before it is planned."""
    fields = [getattr(config, name) for name in type(config).model_fields]
    given = [one for value in fields for one in (value if isinstance(value, tuple) else [value])]
    places = [place_of(one)[0] for one in given if isinstance(one, Path)]
    # Maps that were corrected by hand, and the code; another package's converter has its version.
    places += [out / "joint_maps", *map(Path, datasets.__path__)]
    return _digest(f"{kind.name} {kind.version} {config!r}", places, out)


def is_finished(out: Path, read: str) -> bool:
    """Whether the set in `out` was made from what is `read`, and is as it was noted."""
    note = out / _NOTE
    return note.is_file() and note.read_bytes() == _digest(read, [out]).encode()


def note_finished(out: Path, read: str) -> None:
    """Note of what the set was made. A folder that may only be read is done without."""
    with suppress(OSError):
        write_text(out / _NOTE, _digest(read, [out]))


def _digest(about: str, places: Iterable[Path], skip: Path | None = None) -> str:
    """The digest of a text and of the states of files, and of all files in folders."""
    whole = hashlib.sha256(about.encode(errors="backslashreplace"))
    for place in places:
        found = walk(place, skip)
        own = state_of(place) if place.is_file() else ""
        whole.update(f"{place} {own} {found.unread} {found.others}\n".encode(errors="backslashreplace"))
        for name in found.files:
            if not name.endswith(_NO_PART):
                whole.update(f"{name} {state_of(place / name)}\n".encode(errors="backslashreplace"))
    return whole.hexdigest()
