"""Motion files of a source and what they hold, remembered between runs.

What was found of each file is kept in one JSON file, under a digest of its name, size, times and inode, and
those of its skeleton: the next run reads only files that changed. As in git's index, a file that was changed
just before it was read is read again, for it may have changed once more within one tick of the clock.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

from pydantic import Field

from motionloom.datasets.base.files import sha256_of_json, write_json
from motionloom.datasets.base.lock import file_lock
from motionloom.datasets.convert.common.files import read_in_threads, walk_files
from motionloom.datasets.motion.bvh.asf import JOINED
from motionloom.datasets.schema import Config, UserError, read_plain
from motionloom.datasets.shards.checksums import state_of

SUFFIX = (".bvh", ".amc")
MAX_FILE_BYTES = 1 << 30
"""A motion file beyond this is refused unread: a few hours of text, or a bomb."""
MAX_SKELETON_BYTES = 1 << 20

_VERSION = 4
_RACY_NS = 20_000_000
"""Longest tick by which file systems of Linux keep times; what changed later is read again the next time."""
_SAVE_SECONDS = 30.0
"""Seconds of a long scan that a kill may cost."""


def list_files(source: Path) -> tuple[Path, list[str]]:
    """Return a folder and the motion files in it by name: those under `source`, or `source` itself."""
    if source.is_file():
        root, names = source.parent, [source.name]
    elif source.is_dir():
        root = source
        names = walk_files(source)
    else:
        raise UserError(f"{source}: no such file or folder")
    names = [name for name in names if name.lower().endswith(SUFFIX)]
    if not names:
        raise UserError(f"{source}: no {' or '.join(SUFFIX)} file in it (unpack archives first)")
    return root, names


def read_file(path: Path, label: str) -> bytes:
    """Return the content of a motion file; an .amc's stands behind that of its .asf skeleton and `JOINED`.

    `UserError` when it cannot be read; `label` names it.
    """
    try:
        data = read_plain(path, MAX_FILE_BYTES, label)
        if path.suffix.lower() != ".amc":
            return data
        skeletons = _skeletons(path)
        found = next((one for one in skeletons if one.is_file()), None)
        if found is None:
            names = " or ".join(one.name for one in skeletons[-2:])
            raise UserError(
                f"{label}: no .asf skeleton beside it: an .amc needs its subject's, such as {names}"
            )
        return read_plain(found, MAX_SKELETON_BYTES, label) + JOINED + data
    except OSError as error:
        raise UserError(f"{label}: cannot read ({error.strerror})") from None


def _skeletons(path: Path) -> list[Path]:
    """Where the skeleton of `01_02.amc` may be: `01_02.asf`, or its subject's `01.asf`; of others nowhere."""
    words = path.stem.split("_") if path.suffix.lower() == ".amc" else []
    return [path.with_name("_".join(words[:count]) + ".asf") for count in range(len(words), 0, -1)]


class FoundFile(Config):
    """One motion file as the scan finds it."""

    path: str
    """Inside the source; names it in reports."""
    sha256: str = ""
    """Empty when it cannot be opened."""
    frames: int = 0
    fps: float = 0.0
    skeleton: str = ""
    """The same in files with one hierarchy; empty when it cannot be read."""
    problem: str = ""
    """Reason that the file cannot be read; empty when it can."""


class Scan(Config):
    """The motion files of a source."""

    files: Mapping[str, FoundFile] = Field(default_factory=dict)
    """By a digest of name, size, times and inode."""
    joints: Mapping[str, tuple[str, ...]] = Field(default_factory=dict)
    """Names of the joints of each skeleton."""


Header = Callable[[bytes, str], tuple[int, float, str, tuple[str, ...]]]
"""(content, label) -> frames, frame rate, skeleton, its joints; `UserError` when the file cannot be read."""


def scan_files(
    root: Path,
    names: Sequence[str],
    header: Header,
    *,
    keep: Path | None = None,
    workers: int = 1,
    progress: bool = False,
) -> Scan:
    """Read the header of every motion file, in the order of `names`; `keep` is the file that remembers."""
    with ExitStack() as stack:
        if keep is not None:
            with suppress(OSError):  # no locks, or no writing there: each scans for itself
                keep.parent.mkdir(parents=True, exist_ok=True)
                # Parts of a conversion that begin at once: one reads the source, the others what it found.
                lock = keep.with_suffix(".lock")
                stack.enter_context(file_lock(lock))
                stack.callback(lock.unlink, missing_ok=True)
        return _scan_files(root, names, header, keep, workers, progress)


def _scan_files(
    root: Path, names: Sequence[str], header: Header, keep: Path | None, workers: int, progress: bool
) -> Scan:
    began, states = time.time_ns(), {name: _states(root / name) for name in names}
    keys = {sha256_of_json([_VERSION, name, state]): name for name, state in states.items()}
    known = _load(keep)
    kept = {key: known.files[key] for key in keys if key in known.files}
    found, joints, saved = dict(kept), dict(known.joints), time.monotonic()
    todo = [key for key in keys if key not in kept]
    read = partial(_scan, root, header)
    scans = read_in_threads(
        read, [keys[key] for key in todo], workers=workers, progress=progress, before=len(kept)
    )
    for key, (file, skeleton) in zip(todo, scans, strict=True):
        found[key] = file
        joints.setdefault(file.skeleton, skeleton)
        # A file that could not be opened may be readable the next time.
        changed = max((max(state[1:3]) for state in states[keys[key]] if state), default=0)
        if file.sha256 and changed < began - _RACY_NS:
            kept[key] = file
        if time.monotonic() - saved > _SAVE_SECONDS:
            _save(keep, Scan(files=kept, joints=joints))
            saved = time.monotonic()
    if todo or len(kept) < len(known.files):
        _save(keep, Scan(files=kept, joints=joints))
    return Scan(files={key: found[key] for key in keys}, joints=joints)


def _states(path: Path) -> list[list[int]]:
    return [state_of(one) for one in (path, *_skeletons(path))]


def _load(path: Path | None) -> Scan:
    if path is not None:
        with suppress(UserError):  # none, or not readable: look again
            return Scan.load_json(path)
    return Scan()


def _save(path: Path | None, scan: Scan) -> None:
    if path is not None:
        # It only saves time; a folder that cannot be written shows itself when the shards are.
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, scan.dump())


def _scan(root: Path, header: Header, name: str) -> tuple[FoundFile, tuple[str, ...]]:
    """Scan one file; also the names of its joints."""
    digest = ""
    try:
        data = read_file(root / name, name)
        digest = hashlib.sha256(data).hexdigest()
        frames, fps, skeleton, joints = header(data, name)
    except UserError as error:
        return FoundFile(path=name, sha256=digest, problem=str(error)), ()
    return FoundFile(path=name, sha256=digest, frames=frames, fps=fps, skeleton=skeleton), joints
