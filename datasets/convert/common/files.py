"""Files of a source: text, paths that can never leave the folder, and reading many of them at a time."""

from __future__ import annotations

import errno
import stat
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import read_plain
from motionloom.datasets.base.memory import recall
from motionloom.datasets.base.progress import Meter

T = TypeVar("T")
R = TypeVar("R")

MAX_TEXT_BYTES = 64 << 20
"""A text file beyond this is refused unread; the longest split list of a release has a few MB."""

_MOST_NOTED = 4096
"""Bytes of the captions of one clip; longer texts are lists, which are read each time."""
_LONGEST = 240
"""Bytes of a part of a name, with room for a suffix: file systems have 255."""

_BOM = b"\xef\xbb\xbf"


def read_text_file(path: Path, name: str | None = None) -> str:
    """The text of a UTF-8 file, with or without a byte order mark; every line ends in a plain newline.

    `name` stands for the path in errors that go into a manifest. `UserError` when the file cannot be read, is
    far too long, no text at all, or is not UTF-8; the last names line and byte, counted from 0.
    """
    label = str(path) if name is None else name
    return recall("text", path, lambda: _read_text(path, label), most=_MOST_NOTED)


def _read_text(path: Path, name: str) -> str:
    try:
        raw = read_plain(path, MAX_TEXT_BYTES)
    except OSError as error:
        raise UserError(f"{name}: cannot read ({error.strerror})") from None
    if b"\0" in raw or raw.startswith(b"PK\x03\x04"):
        raise UserError(f"{name}: not a text file in UTF-8; save it as text, CSV or JSON in UTF-8")
    body = raw.removeprefix(_BOM)
    try:
        text = body.decode("utf-8")
    except UnicodeDecodeError as error:
        at = error.start + len(raw) - len(body)
        line = raw[:at].count(b"\n") + 1
        raise UserError(
            f"{name}:{line}: not UTF-8 text at byte {at} (0x{raw[at]:02x}); save the file as UTF-8"
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def check_id(clip_id: str, where: str) -> str:
    """The id, if it can never leave a folder when something is named after it; `UserError` otherwise."""
    parts = clip_id.split("/")
    if (
        not clip_id
        or "\\" in clip_id
        or not clip_id.isprintable()
        or any(
            part in ("", ".", "..") or len(part.encode("utf-8", "surrogateescape")) > _LONGEST
            for part in parts
        )
        or ":" in parts[0]
    ):
        raise UserError(
            f"{where}: clip id '{clip_id[:80]!s}' is not a plain relative name; rename it, without \\ : "
            f"tabs or .., and with at most {_LONGEST} bytes a part"
        )
    return clip_id


def inside(root: Path, relative: str, name: str | None = None) -> Path:
    """`root / relative`, which need not exist; `UserError` unless it really lies below `root`.

    Refused: absolute names, `..`, back slashes, drive letters, and links that point out of `root`. `root`
    itself may be a link (people keep the parts of a release on different disks). `name` stands for `relative`
    in errors.
    """
    name = relative if name is None else name
    check_id(relative, name)
    path = root
    linked = False
    for part in relative.split("/"):
        path = path / part
        linked = linked or path.is_symlink()
    if not linked:  # the usual case, at a third of the cost of resolving
        return path
    try:
        safe = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # a link that points at itself
        safe = False
    if not safe:
        raise UserError(f"{name}: a link that leaves {root.name}/; copy the file in its place")
    return path


@dataclass(frozen=True)
class Walk:
    """Every entry of a folder and of the folders below it, by its name from there. Folders are no entries."""

    files: list[str] = field(default_factory=list)
    """Sorted."""
    unread: dict[str, str] = field(default_factory=dict)
    """Entries that are not there or may not be read, folders with a slash behind them, and why."""
    others: dict[str, str] = field(default_factory=dict)
    """Entries that are no files, and links to folders that have another name here, and what they are."""


def walk(root: Path, skip: Path | None = None) -> Walk:
    """Return all entries under a folder, whatever is wrong with any of them, but for those of folder `skip`.

    Folders behind links are followed, each folder once: by its own name where it lies under `root` itself,
    else by the first link.
    """
    found = Walk()
    seen = set[tuple[int, int]]()
    left = None if skip is None or not skip.is_dir() else _identity(skip)
    folders = [""]
    links = list[str]()
    while folders or links:
        folder = folders.pop() if folders else links.pop(links.index(min(links)))
        try:
            identity = _identity(root / folder)
            entries = [path.name for path in (root / folder).iterdir()]
        except OSError as error:
            found.unread[f"{folder}/"] = _reason(error)
            continue
        if identity == left:
            continue
        if identity in seen:
            found.others[f"{folder}/"] = "a folder that is read by another name"
            continue
        seen.add(identity)
        for entry in entries:
            name = f"{folder}/{entry}" if folder else entry
            if entry == "__MACOSX" or entry.startswith("._"):
                found.others[name] = "what a Mac puts into archives"
                continue
            try:
                mode = (root / name).stat().st_mode
            except OSError as error:
                found.unread[name] = _reason(error)
                continue
            if stat.S_ISDIR(mode):
                (links if (root / name).is_symlink() else folders).append(name)
            elif stat.S_ISREG(mode):
                found.files.append(name)
            else:
                found.others[name] = "a pipe, socket or device"
    found.files.sort()
    return found


def _identity(folder: Path) -> tuple[int, int]:
    about = folder.stat()
    return about.st_dev, about.st_ino


def _reason(error: OSError) -> str:
    known = {errno.ENOENT: "a link that leads nowhere", errno.ELOOP: "a link that leads in a circle"}
    return known.get(error.errno or 0, f"may not be read ({error.strerror})")


def walk_files(root: Path) -> list[str]:
    """Return the names of all files under a folder, relative to it and sorted."""
    return walk(root).files


def files_in(folder: Path, suffix: str) -> list[str]:
    """Return the sorted names of a folder's own entries that end so, whether or not they can be read, without
    hidden ones. `UserError` for a folder that may not be read.
    """
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise UserError(f"{folder}: cannot read ({error.strerror})") from None
    return sorted(name for name in names if name.endswith(suffix) and name[0] != ".")


def read_in_threads(
    read: Callable[[T], R], items: Sequence[T], *, workers: int, progress: bool
) -> Iterator[R]:
    """Yield `read(item)` for every item, in their order.

    Threads are enough: opening many files waits for the disk, unpacking and hashing run outside the
    interpreter's lock.
    """
    meter = Meter("reading the source", len(items), shown=progress)
    with meter, ThreadPoolExecutor(max(workers, 1)) as pool:
        # By thousands: a task that waits takes a kilobyte.
        for first in range(0, len(items), 4096):
            for made in pool.map(read, items[first : first + 4096]):
                yield made
                meter.advance()
