"""What the motion files of a source hold, batch by batch, remembered between runs.

To know which clips an archive holds it must be unpacked, and planning needs to know. So what was found is
kept in one JSON file, each batch under a digest of its files' names, sizes and times of change: the next run,
or the next machine, looks only at batches that changed.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from motionloom.datasets.base.files import sha256_of_json, write_json
from motionloom.datasets.convert.common.archives import Batch
from motionloom.datasets.convert.common.files import read_in_threads
from motionloom.datasets.convert.common.plan import drop
from motionloom.datasets.schema import Config, Dropped, UserError

_VERSION = 2
_SAVE_SECONDS = 30.0
"""How much of a long scan a kill may cost."""


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
    """Why the file cannot be read; empty when it can."""


class BatchScan(Config):
    """What one batch holds; `problem` when it is damaged somewhere."""

    files: list[FoundFile]
    problem: Dropped | None


Header = Callable[[bytes, str], tuple[int, float, str]]
"""(content, label) -> frames, frame rate and skeleton; `UserError` when the file cannot be read."""


class _Memory(Config):
    """The file that remembers: batches by the digest of their state."""

    batches: dict[str, BatchScan]


def scan_batches(
    batches: list[Batch],
    suffix: str,
    header: Header,
    *,
    keep: Path | None = None,
    workers: int = 1,
    progress: bool = False,
) -> list[BatchScan]:
    """Read the header of every file with `suffix`, in batch order; `keep` is the file that remembers."""
    keys = [sha256_of_json([_VERSION, suffix, batch.state()]) for batch in batches]
    known = _load(keep)
    kept = {key: known[key] for key in keys if key in known}
    todo = [batch for key, batch in zip(keys, batches, strict=True) if key not in kept]
    made: list[BatchScan] = []
    saved, changed = time.monotonic(), bool(todo) or len(kept) < len(known)
    missing = [key for key in keys if key not in kept]
    scans = read_in_threads(
        partial(_scan, suffix, header), todo, workers=workers, progress=progress, before=len(kept)
    )
    for key, (found, certain) in zip(missing, scans, strict=True):
        made.append(found)
        if certain:
            kept[key] = found
        if time.monotonic() - saved > _SAVE_SECONDS:
            _save(keep, kept)
            saved = time.monotonic()
    if changed:
        _save(keep, kept)
    new = iter(made)
    missed = set(missing)
    return [next(new) if key in missed else kept[key] for key in keys]


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


def _scan(suffix: str, header: Header, batch: Batch) -> tuple[BatchScan, bool]:
    """What a batch holds, and whether that depends on the files alone (and not on a right to read them)."""
    files: list[FoundFile] = []
    certain = True
    try:
        for file in batch.read(suffix):
            frames, fps, skeleton, problem = 0, 0.0, "", file.error
            certain = certain and not file.error
            try:
                if not problem:
                    frames, fps, skeleton = header(file.data, file.label)
            except UserError as error:
                problem = str(error)
            sha256 = hashlib.sha256(file.data).hexdigest()
            files.append(
                FoundFile(
                    label=file.label,
                    path=file.path,
                    sha256=sha256,
                    frames=frames,
                    fps=fps,
                    skeleton=skeleton,
                    problem=problem,
                )
            )
    except UserError as error:
        return BatchScan(files=files, problem=drop(batch.label, error)), False
    return BatchScan(files=files, problem=None), certain
