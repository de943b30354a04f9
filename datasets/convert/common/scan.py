"""Motion files of a source, loose or in tar archives, and what they hold, remembered between runs.

Nothing is ever extracted: a member's name is only a label, links and devices are skipped, and compressed
archives are read once from front to back (xz cannot do otherwise), one member in memory at a time. What was
found is kept in one JSON file, each batch under a digest of its files' names, sizes and times of change: the
next run, or the next machine, looks only at batches that changed.
"""

from __future__ import annotations

import hashlib
import lzma
import tarfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

from motionloom.datasets.base.files import sha256_of_json, write_json
from motionloom.datasets.convert.common.files import read_in_threads
from motionloom.datasets.motion.bvh.asf import JOINED
from motionloom.datasets.schema import Config, Dropped, UserError
from motionloom.datasets.shards.left_out import drop

ARCHIVES = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".txz", ".tar.bz2")
LOOSE_FILES_PER_BATCH = 64
MAX_FILE_BYTES = 1 << 30
"""A motion file beyond this is refused unread: a few hours of text, or a bomb."""


SUFFIX = (".bvh", ".amc")
MAX_SKELETON_BYTES = 1 << 20


@dataclass(frozen=True)
class SourceFile:
    """One motion file: `label` names it in reports, `path` inside the source or the archive."""

    label: str
    path: str
    data: bytes
    error: str = ""
    """Reason for having no data (unreadable, too large)."""


@dataclass(frozen=True)
class Batch:
    """The unit of parallel work: one archive, or a run of loose files."""

    root: Path
    archive: str | None
    files: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return self.archive or self.files[0]

    def state(self) -> list[tuple[str, int, int]]:
        out = []
        for name in (self.archive,) if self.archive is not None else self.files:
            try:
                about = (self.root / name).stat()
                out.append((name, about.st_size, about.st_mtime_ns))
            except OSError:
                out.append((name, -1, 0))
        return out

    def read(self) -> Iterator[SourceFile]:
        """Every motion file, in archive order. `UserError` when the archive is damaged there.

        The data of an .amc file come behind those of its .asf skeleton and `JOINED`.
        """
        if self.archive is not None:
            yield from _read_archive(self.root / self.archive, self.archive)
            return
        for name in self.files:
            path = self.root / name
            try:
                problem = _too_large(path.stat().st_size)
                data = b"" if problem else path.read_bytes()
                if name.lower().endswith(".amc") and not problem:
                    beside = [path.with_name(PurePosixPath(one).name) for one in _skeleton_names(name)]
                    skeletons = {str(one): one.read_bytes() for one in beside if one.is_file()}
                    data, problem = _with_skeleton(str(path), data, skeletons)
                yield SourceFile(name, name, data, problem)
            except OSError as error:
                yield SourceFile(name, name, b"", f"cannot read ({error.strerror})")


def list_batches(source: Path) -> list[Batch]:
    """Batches under `source` (a folder, a motion file or an archive), in name order."""
    if source.is_file():
        names, root = [source.name], source.parent
    elif source.is_dir():
        root = source
        names = sorted(p.relative_to(source).as_posix() for p in source.rglob("*") if p.is_file())
    else:
        raise UserError(f"{source}: no such file or folder")
    archives = [name for name in names if name.lower().endswith(ARCHIVES)]
    loose = [name for name in names if name.lower().endswith(SUFFIX)]
    batches = [Batch(root, name) for name in archives]
    for first in range(0, len(loose), LOOSE_FILES_PER_BATCH):
        batches.append(Batch(root, None, tuple(loose[first : first + LOOSE_FILES_PER_BATCH])))
    if not batches:
        raise UserError(
            f"{source}: no {' or '.join(SUFFIX)} file and no archive ({', '.join(ARCHIVES)}) in it"
        )
    return batches


def _read_archive(path: Path, label: str) -> Iterator[SourceFile]:
    last = "the start"
    skeletons: dict[str, bytes] | None = None
    try:
        with tarfile.open(path, "r|*") as archive:
            for member in archive:
                if not member.isreg() or not member.name.lower().endswith(SUFFIX):
                    continue
                where = f"{label}/{member.name}"
                problem = _too_large(member.size)
                file = None if problem else archive.extractfile(member)
                data = file.read() if file else b""
                if member.name.lower().endswith(".amc") and not problem:
                    skeletons = _skeletons(path) if skeletons is None else skeletons
                    data, problem = _with_skeleton(member.name, data, skeletons)
                yield SourceFile(where, member.name.removeprefix("./"), data, problem)
                last = f"'{member.name}'"
    except (tarfile.TarError, EOFError, OSError, lzma.LZMAError, zlib.error) as error:
        raise UserError(f"{label}: damaged archive after {last} ({error or type(error).__name__})") from None


def _skeleton_names(name: str) -> list[str]:
    """Names of the .asf of an .amc, best first: `01_02.asf`, then `01.asf` for `01_02.amc`."""
    path = PurePosixPath(name)
    words = path.stem.split("_")
    return [str(path.with_name("_".join(words[:count]) + ".asf")) for count in range(len(words), 0, -1)]


def _with_skeleton(name: str, data: bytes, skeletons: Mapping[str, bytes]) -> tuple[bytes, str]:
    """An .amc's data behind its skeleton's, and what is wrong when there is none."""
    wanted = _skeleton_names(name)
    found = next((skeletons[one] for one in wanted if one in skeletons), None)
    if found is None:
        names = " or ".join(PurePosixPath(one).name for one in wanted[-2:])
        return b"", f"no .asf skeleton beside it: an .amc needs its subject's, such as {names}"
    return found + JOINED + data, ""


def _skeletons(archive: Path) -> dict[str, bytes]:
    """Every .asf of an archive."""
    with tarfile.open(archive, "r|*") as members:
        return {
            one.name: file.read()
            for one in members
            if one.name.lower().endswith(".asf")
            and one.size <= MAX_SKELETON_BYTES
            and (file := members.extractfile(one)) is not None
        }


def _too_large(size: int) -> str:
    if size <= MAX_FILE_BYTES:
        return ""
    return f"{size} bytes, more than a motion file may have ({MAX_FILE_BYTES})"


_VERSION = 2
_SAVE_SECONDS = 30.0
"""Seconds of a long scan that a kill may cost."""


class FoundFile(Config):
    """One motion file as the scan finds it."""

    label: str
    """Names it in reports."""
    path: str
    """Inside the source or the archive."""
    sha256: str
    frames: int
    fps: float
    skeleton: str
    """The same in files with one hierarchy; empty when it cannot be read."""
    problem: str
    """Reason that the file cannot be read; empty when it can."""


class BatchScan(Config):
    """The content of one batch; `problem` when it is damaged somewhere."""

    files: list[FoundFile]
    problem: Dropped | None
    joints: dict[str, tuple[str, ...]]
    """Names of the joints of each skeleton."""


Header = Callable[[bytes, str], tuple[int, float, str, tuple[str, ...]]]
"""(content, label) -> frames, frame rate, skeleton, its joints; `UserError` when the file cannot be read."""


class _Memory(Config):
    batches: dict[str, BatchScan]


def scan_batches(
    batches: list[Batch],
    header: Header,
    *,
    keep: Path | None = None,
    workers: int = 1,
    progress: bool = False,
) -> list[BatchScan]:
    """Read the header of every motion file, in batch order; `keep` is the file that remembers."""
    keys = [sha256_of_json([_VERSION, SUFFIX, batch.state()]) for batch in batches]
    known = _load(keep)
    kept = {key: known[key] for key in keys if key in known}
    todo = [(key, batch) for key, batch in zip(keys, batches, strict=True) if key not in kept]
    found, saved = dict(kept), time.monotonic()
    # Results are saved now and then, since a scan of archives takes hours and may be killed.
    read = partial(_scan, header)
    new = [batch for _, batch in todo]
    scans = read_in_threads(read, new, workers=workers, progress=progress, before=len(kept))
    for (key, _), (scan, certain) in zip(todo, scans, strict=True):
        found[key] = scan
        if certain:
            kept[key] = scan
        if time.monotonic() - saved > _SAVE_SECONDS:
            _save(keep, kept)
            saved = time.monotonic()
    if todo or len(kept) < len(known):
        _save(keep, kept)
    return [found[key] for key in keys]


def _load(path: Path | None) -> dict[str, BatchScan]:
    if path is not None:
        with suppress(UserError):  # none, or not readable: look again
            return _Memory.load_json(path).batches
    return {}


def _save(path: Path | None, batches: dict[str, BatchScan]) -> None:
    if path is not None:
        # It only saves time; a folder that cannot be written shows itself when the shards are.
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, _Memory(batches=batches).dump())


def _scan(header: Header, batch: Batch) -> tuple[BatchScan, bool]:
    """Scan one batch; also whether the result depends on the files alone, not on a right to read them."""
    files: list[FoundFile] = []
    joints: dict[str, tuple[str, ...]] = {}
    certain = True
    try:
        for file in batch.read():
            frames, fps, skeleton, problem = 0, 0.0, "", file.error
            certain = certain and not file.error
            try:
                if not problem:
                    frames, fps, skeleton, names = header(file.data, file.label)
                    joints.setdefault(skeleton, names)
            except UserError as error:
                problem = str(error)
            about = {"label": file.label, "path": file.path, "sha256": hashlib.sha256(file.data).hexdigest()}
            files.append(FoundFile(**about, frames=frames, fps=fps, skeleton=skeleton, problem=problem))
    except UserError as error:
        return BatchScan(files=files, problem=drop(batch.label, error), joints=joints), False
    return BatchScan(files=files, problem=None, joints=joints), certain
