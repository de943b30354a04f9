"""What was read of source files, noted for the next process: of eight parts of a conversion one reads all.

A note is plain JSON: digest of a file's size, times and inode and of what was read -> what that was. A
changed file, or one on another disk, has another digest, so what is noted is never out of date.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import State, sha256_of, state_of, write_json
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.base.lock import file_lock

T = TypeVar("T")

_MOST_BYTES = 2**33
_CONTENT = "="
"""Begins the keys of checksums, which are asked for again after the plan."""
_known: dict[str, Any] = {}
"""What this process has read, or found noted."""
_asked: list[set[str]] = []
"""What has been asked for since a note was opened."""


@contextmanager
def remembering(note: Path) -> Iterator[None]:
    """Context in which `recall` knows what is noted, and the note is written anew at its end.

    One process at a time: the others wait, and then find it noted. A place that may only be read, or that has
    no locks, is done without.
    """
    lock = note.with_name(f"{note.name}.lock")
    asked = set[str]()
    with ExitStack() as stack:
        with suppress(OSError):
            note.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(file_lock(lock))
            stack.callback(lock.unlink, missing_ok=True)
        noted: dict[str, Any] = {}
        with suppress(UserError, OSError, ValueError, TypeError):  # none, or damaged
            noted = dict(parse_json(read_plain(note, _MOST_BYTES), str(note)))
            _known.update((key, value) for key, value in noted.items() if isinstance(value, str | int))
        _asked.append(asked)
        stack.callback(_asked.pop)
        yield
        if asked != noted.keys():
            with suppress(OSError):
                write_json(note, {key: _known[key] for key in sorted(asked)})
        for key in asked:
            if not key.startswith(_CONTENT):  # what a plan has read is in it
                del _known[key]


def recall(what: str, path: Path, read: Callable[[], T], *, most: int | None = None) -> T:
    """Return what `read` returns of a file, text or a number, unless it is known of the file as it is now;
    of a file of more than `most` bytes nothing is.
    """
    state = state_of(path)
    if not _asked or not state or (most is not None and state[0] > most):
        return read()
    key = _key(what, state)
    found: T = _known[key] if key in _known else read()
    _known[key] = found
    _asked[-1].add(key)
    return found


def content_of(path: Path) -> str:
    """sha256 of a source file; it is read again only where it has changed."""
    key = _CONTENT + _key("sha256", state_of(path))
    if key not in _known:
        _known[key] = sha256_of(path)
    if _asked:
        _asked[-1].add(key)
    return str(_known[key])


def _key(what: str, state: State) -> str:
    return base64.b64encode(hashlib.blake2b(f"{what} {state}".encode(), digest_size=12).digest()).decode()
