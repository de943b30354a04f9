"""Motion files of a source folder, loose or inside tar archives, read as bytes in a fixed order.

Nothing is ever extracted: a member's name is only a label, links and devices are skipped, and compressed
archives are read once from front to back (xz cannot do otherwise), one member in memory at a time.
"""

from __future__ import annotations

import lzma
import tarfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from motionloom.datasets.schema import UserError

ARCHIVES = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".txz", ".tar.bz2")
LOOSE_FILES_PER_BATCH = 64
MAX_FILE_BYTES = 1 << 30
"""A motion file beyond this is refused unread: a few hours of text, or a bomb."""


@dataclass(frozen=True)
class SourceFile:
    """One motion file: `label` names it in reports, `path` inside the source or the archive."""

    label: str
    path: str
    data: bytes
    error: str = ""
    """Why there are no data (unreadable, too large)."""


@dataclass(frozen=True)
class Batch:
    """The unit of parallel work: one archive, or a run of loose files."""

    root: Path
    archive: str | None
    files: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Name of the batch in reports."""
        return self.archive or self.files[0]

    def state(self) -> list[tuple[str, int, int]]:
        """Name, size and time of the last change (ns) of every file; size -1 when it cannot be looked at."""
        out = []
        for name in (self.archive,) if self.archive is not None else self.files:
            try:
                about = (self.root / name).stat()
                out.append((name, about.st_size, about.st_mtime_ns))
            except OSError:
                out.append((name, -1, 0))
        return out

    def read(self, suffix: str) -> Iterator[SourceFile]:
        """Every file with `suffix`, in archive order. `UserError` when the archive is damaged there."""
        if self.archive is not None:
            yield from _read_archive(self.root / self.archive, self.archive, suffix)
            return
        for name in self.files:
            path = self.root / name
            try:
                problem = _too_large(path.stat().st_size)
                yield SourceFile(name, name, b"" if problem else path.read_bytes(), problem)
            except OSError as error:
                yield SourceFile(name, name, b"", f"cannot read ({error.strerror})")


def list_batches(source: Path, suffix: str) -> tuple[list[Batch], int]:
    """Batches under `source` (a folder, a motion file or an archive), in name order, and how many others."""
    if source.is_file():
        names, root = [source.name], source.parent
    elif source.is_dir():
        root = source
        names = sorted(p.relative_to(source).as_posix() for p in source.rglob("*") if p.is_file())
    else:
        raise UserError(f"{source}: no such file or folder")
    archives = [name for name in names if name.lower().endswith(ARCHIVES)]
    loose = [name for name in names if name.lower().endswith(suffix)]
    batches = [Batch(root, name) for name in archives]
    for first in range(0, len(loose), LOOSE_FILES_PER_BATCH):
        batches.append(Batch(root, None, tuple(loose[first : first + LOOSE_FILES_PER_BATCH])))
    if not batches:
        raise UserError(f"{source}: no {suffix} file and no archive ({', '.join(ARCHIVES)}) in it")
    return batches, len(names) - len(archives) - len(loose)


def _read_archive(path: Path, label: str, suffix: str) -> Iterator[SourceFile]:
    last = "the start"
    try:
        with tarfile.open(path, "r|*") as archive:
            for member in archive:
                if not member.isreg() or not member.name.lower().endswith(suffix):
                    continue
                where = f"{label}/{member.name}"
                problem = _too_large(member.size)
                file = None if problem else archive.extractfile(member)
                yield SourceFile(where, member.name.removeprefix("./"), file.read() if file else b"", problem)
                last = f"'{member.name}'"
    except (tarfile.TarError, EOFError, OSError, lzma.LZMAError, zlib.error) as error:
        raise UserError(f"{label}: damaged archive after {last} ({error or type(error).__name__})") from None


def _too_large(size: int) -> str:
    if size <= MAX_FILE_BYTES:
        return ""
    return f"{size} bytes, more than a motion file may have ({MAX_FILE_BYTES})"
