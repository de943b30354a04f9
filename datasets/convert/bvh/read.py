"""Motion files of a source: BVH, and AMC behind the ASF of its subject; and what their headers say."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.base.memory import recall
from motionloom.datasets.convert.common.files import read_in_threads, walk_files
from motionloom.datasets.motion.bvh.asf import FPS, JOINED, frame_marks, read_amc, skeleton_of
from motionloom.datasets.motion.bvh.joint_map import skeleton_key
from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh
from motionloom.datasets.motion.bvh.text import (
    MAX_FILE_BYTES,
    count_frames,
    find_motion,
    load_text,
    parse_hierarchy,
)
from motionloom.datasets.shards.left_out import drop

SUFFIX = (".bvh", ".amc")
READERS: dict[str, Callable[[Path, str], bytes]] = {}
"""Other endings, of packages, and what makes a BVH text of such a file; errors call it by the second word."""
MAX_SKELETON_BYTES = 1 << 20


def list_files(source: Path) -> tuple[Path, list[str]]:
    """Return a folder and the motion files in it by name: those under `source`, or `source` itself."""
    if source.is_file():
        root = source.parent
        names = [source.name]
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
    """Return a motion file's content, an .amc's behind its .asf and `JOINED`; `label` names it in errors."""
    if reader := READERS.get(path.suffix.lower()):
        return reader(path, label)
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
    """Where the skeleton of `01_02.amc` may be: `01_02.asf`, or its subject's `01.asf`."""
    words = path.stem.split("_")
    return [path.with_name("_".join(words[:count]) + ".asf") for count in range(len(words), 0, -1)]


@dataclass(frozen=True)
class FoundFile:
    """One motion file as the scan finds it."""

    path: str
    """Inside the source; names it in reports."""
    sha256: str = ""
    """Empty when it cannot be read."""
    frames: int = 0
    fps: float = 0.0
    skeleton: str = ""
    """The same in files with one hierarchy; empty when it cannot be read."""
    joints: tuple[str, ...] = ()
    """Names of the skeleton's joints."""
    miscounted: bool = False
    """Whether its header states another number of frames."""
    problem: str = ""
    """Reason that the file cannot be read; empty when it can."""


def scan_files(root: Path, names: Sequence[str], *, workers: int, progress: bool) -> list[FoundFile]:
    """Read the header of every motion file, in the order of `names`."""
    return list(read_in_threads(partial(_scan, root), names, workers=workers, progress=progress))


def _scan(root: Path, name: str) -> FoundFile:
    path = root / name

    def read() -> str:
        data = read_file(path, name)
        return json.dumps([hashlib.sha256(data).hexdigest(), *_read_header(data, name)])

    try:
        # Others are read with further files.
        noted = recall("bvh", path, read) if path.suffix.lower() == ".bvh" else read()
        digest, frames, fps, skeleton, joints, miscounted = parse_json(noted, name)
        return FoundFile(name, digest, frames, fps, skeleton, tuple(joints), miscounted)
    except Exception as error:  # whatever bad bytes or names make of the libraries below
        return FoundFile(name, problem=drop(name, error).reason)


def read_motion(data: bytes, label: str) -> BvhMotion:
    """The motion of a BVH file, or of an AMC file behind its skeleton."""
    asf, joined, amc = data.partition(JOINED)
    return read_amc(asf, amc, name=label) if joined else read_bvh(data, name=label)


def _read_header(data: bytes, label: str) -> tuple[int, float, str, tuple[str, ...], bool]:
    """Frames, frame rate, skeleton, joints, and whether the header states another number of frames."""
    asf, joined, amc = data.partition(JOINED)
    if joined:
        found, parents = skeleton_of(asf, label)
        return len(frame_marks(amc, label)), FPS, skeleton_key(found, parents), found, False
    text, where = load_text(data, label)
    section = find_motion(text, where)
    frames = count_frames(text, section, where)
    joints = parse_hierarchy(text[: section.start], where)
    key = skeleton_key(joints.names, joints.parents)
    return frames, section.fps, key, tuple(joints.names), frames != section.frames
