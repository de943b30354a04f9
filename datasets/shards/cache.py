"""A folder of downloaded files that several processes share, kept below a size limit.

Names hold a checksum of the content (or of the manifest that decides it), so a file is never out of date. One
process downloads a file while the others that want it wait; it appears by a rename, whole or not at all.
Locks are the kernel's (`flock`), so a killed process leaves none. The least recently used file is deleted
first; a process that has it open keeps its content.

fsspec's `filecache` would not do: there a file appears before its checksum can be compared, the size is not
limited, and processes that want the same file each download it.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.lock import file_lock

_OURS = re.compile(r"[0-9a-f]{64}\.(tar|index\.npz|manifest\.json)")
"""Names of cached files. No other file is ever deleted: a recipe may name any folder for the cache."""

_PART = ".part"
_LOCKS = ".locks"


class CacheConfig(Config):
    """Cache of a server's shards on this machine. Folders are read in place, without a cache."""

    folder: str | None = None
    """A folder that processes and runs may share; unset means `motionloom/shards` in the user's cache."""
    gigabytes: float = Field(50.0, gt=0)
    """Size limit (10^9 bytes); the least recently used shards are deleted first."""

    @property
    def limit(self) -> int:
        return int(self.gigabytes * 1e9)


class FileCache:
    """Files by name. Nothing is created before the first one is asked for."""

    def __init__(self, config: CacheConfig) -> None:
        cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        self.folder = Path(config.folder or Path(cache, "motionloom", "shards")).expanduser()
        self.limit = config.limit

    def find(self, name: str) -> BinaryIO | None:
        """Open a cached file and mark it as used now; None when it is not cached."""
        path = self.folder / name
        try:
            file = open_plain(path)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error}); delete it") from None
        os.utime(file.fileno(), ns=(time.time_ns(), time.time_ns()))
        return file

    def get(self, name: str, size: int, make: Callable[[Path], object]) -> BinaryIO:
        """Open the file `name`; if missing, free `size` bytes and let `make` write it to a path."""
        if size > self.limit:
            raise UserError(
                f"{self.folder}: a file of {size} bytes is larger than the cache's limit of {self.limit}; "
                f"raise its gigabytes"
            )
        cached = self.find(name)
        if cached is not None:
            return cached
        path = self.folder / name
        # Another process may have downloaded it while this one waited for the lock: look again.
        with self._lock(name):
            cached = self.find(name)
            if cached is not None:
                return cached
            alone = self._make_room(size)
            part = path.with_name(f".{name}{_PART}")
            try:
                make(part)
                file = part.open("rb")
                os.fsync(file.fileno())
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
        if not alone:  # what others were fetching has grown since; alone, one look at the folder is enough
            self._make_room(0, keep=name)
        return file

    def _make_room(self, size: int, keep: str = "") -> bool:
        """Delete temporary files of killed processes, and the oldest files until `size` bytes fit; whether
        nobody else is fetching a file.
        """
        files = []
        alone = True
        used = size
        with os.scandir(self.folder) as entries:
            for entry in entries:
                part = entry.name.startswith(".") and entry.name.endswith(_PART)
                whole = entry.name.removeprefix(".").removesuffix(_PART) if part else entry.name
                if not entry.is_file() or not _OURS.fullmatch(whole):
                    continue
                if part:  # of a killed download, unless somebody holds its lock
                    with self._lock(whole, wait=False) as mine:
                        alone = alone and mine
                        if mine:
                            (self.folder / entry.name).unlink(missing_ok=True)
                try:
                    status = entry.stat()
                except FileNotFoundError:  # another process was faster
                    continue
                used += status.st_size
                if entry.name != keep and not part:
                    files.append((status.st_mtime_ns, entry.name, status.st_size))
        for _, name, length in sorted(files):
            if used <= self.limit:
                break
            (self.folder / name).unlink(missing_ok=True)
            used -= length
        return alone

    @contextmanager
    def _lock(self, name: str, *, wait: bool = True) -> Iterator[bool]:
        """Context with the lock of `name` and a few others; False if it is taken and `wait` is off."""
        path = self.folder / _LOCKS / name[:2]
        with ExitStack() as stack:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                mine = stack.enter_context(file_lock(path, wait=wait))
            except OSError as error:
                raise UserError(
                    f"{self.folder}: the cache folder cannot be used ({error}); name another"
                ) from None
            yield mine
