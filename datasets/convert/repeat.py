"""A conversion given again: where neither its source nor its shards have changed, nothing is planned.

A finished set notes the digest of size, times and inode of all that it was made from and of what was made.
With another file, setting or release the digest is another, and the conversion plans anew.
"""

from __future__ import annotations

import hashlib
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from motionloom import datasets
from motionloom.datasets.base.files import state_of, write_text
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter
from motionloom.datasets.convert.common.files import walk

FINISHED_FILE = ".finished"
_MADE = (".tar", ".index", ".npz", ".json", ".txt", ".md")
"""Endings of files beside the shards that count; pages for people do not."""


class Repeat:
    """All that a conversion into `out` would read, as it is before it is planned."""

    def __init__(self, kind: type[Converter[Any, Any]], config: ConvertConfig, out: Path) -> None:
        self._out = out
        self._digest = hashlib.sha256()
        self._add(kind.name, kind.version, repr(config))
        fields = [getattr(config, name) for name in type(config).model_fields]
        given = [one for value in fields for one in (value if isinstance(value, tuple) else [value])]
        places = [part for one in given if isinstance(one, Path) for part in _parts(str(one))]
        # The code too, ours and that of another package's converter.
        code = [getattr(sys.modules[base.__module__], "__file__", None) for base in kind.__mro__]
        for place in map(Path, (*places, out / "joint_maps", *filter(None, code), *datasets.__path__)):
            self._add(place, state_of(place) if place.is_file() else "")
            found = walk(place, skip=out)
            self._add(found.unread, found.others)
            for name in found.files:
                if not name.endswith(".pyc"):
                    self._add(name, state_of(place / name))

    def _add(self, *facts: object) -> None:
        self._digest.update(f"{facts}\n".encode(errors="backslashreplace"))

    def is_finished(self) -> bool:
        """Whether the set is as it was noted, and so is all that it was made from."""
        try:
            return (self._out / FINISHED_FILE).read_text(encoding="utf-8") == self._with_made()
        except (OSError, ValueError):
            return False

    def note(self) -> None:
        """Note that the set is finished. A folder that may only be read is done without."""
        with suppress(OSError):
            write_text(self._out / FINISHED_FILE, self._with_made())

    def _with_made(self) -> str:
        """The digest of what is read and of what has been made."""
        both = self._digest.copy()
        for path in sorted(self._out.iterdir()):
            if path.name.endswith(_MADE) and not path.name.startswith("."):
                both.update(f"{path.name} {state_of(path)}\n".encode(errors="backslashreplace"))
        return both.hexdigest()


def _parts(given: str) -> list[str]:
    """A path, and those that it may be with words behind it: `captions.csv:text=sentence`."""
    words = given.split(":")
    return [":".join(words[:count]) for count in range(1, len(words) + 1)]
