"""A file system of a few hundred kilobytes that can be filled up, and made larger."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PAGE = 4096


def why_not() -> str:
    """Why none can be mounted here; empty when one can."""
    if os.name != "posix" or os.geteuid() != 0:
        return "mounting a file system needs root"
    if shutil.which("mount") is None:
        return "not installed: mount"
    return ""


class SmallDisk:
    """A mounted tmpfs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / "filler"

    def fill(self, leave: int) -> None:
        """Occupy all but about `leave` bytes."""
        state = os.statvfs(self.folder)
        free = state.f_bavail * state.f_frsize - leave
        with self._filler.open("ab") as file:
            file.write(b"x" * (free // PAGE * PAGE))

    def make_room(self) -> None:
        """Remove what `fill` has written."""
        self._filler.unlink()


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[SmallDisk]:
    """A disk of `size` bytes at `folder`, for as long as the block runs."""
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], check=True)
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
