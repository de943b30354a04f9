"""Reading a shard's directory without trusting it.

Only plain files, contiguous per key, are accepted; a path, a link, a device, a repeated
or interleaved key or an object array stops the read with the shard's and the member's name. Nothing is ever
extracted, and nothing is unpickled.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import open_plain, require_plain
from motionloom.datasets.base.register import discover
from motionloom.datasets.motion.npz import read_npy_header
from motionloom.datasets.shards.sample import MEMBERS

MOST_CLIPS = 10_000
"""Clips of one shard; a directory of more is a bomb."""


@dataclass
class TarClip:
    """One key of a shard: member name -> (offset of its content, size), both in bytes."""

    key: str
    members: dict[str, tuple[int, int]] = field(default_factory=dict)


def scan_tar(path: Path, *, most: int = MOST_CLIPS, column: str = "") -> list[TarClip]:
    """Return the clips of a shard in order, at most `most`; a `UserError` names the fault.

    Each has a motion and its `meta.json`, or the one member of a `column`.
    """
    needed = {column} if column else {"motion.npy", "meta.json"}
    clips: list[TarClip] = []
    seen: set[str] = set()
    size = require_plain(path)
    end = 0
    if size == 0:
        raise UserError(f"{path}: empty file, 0 bytes: an interrupted download or write")
    with open_plain(path) as file:
        for info in _entries(path, file):
            # Contents fill whole blocks; behind the last one nothing but zeros may follow (`_check_end`).
            end = info.offset_data + -(-info.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
            key, member = _checked_name(path, info, column)
            if info.offset_data + info.size > size:
                last = f"the last whole key is '{clips[-1].key}'" if clips else "no key is whole"
                raise UserError(f"{path}: truncated inside {info.name!r}; {last}")
            # A new key ends the clip before it, which must be whole; a key may not come again later.
            if not clips or clips[-1].key != key:
                if clips:
                    _require_whole(path, clips, needed)
                if key in seen:
                    raise UserError(
                        f"{path}: duplicate key {key!r}: it comes again after others, or its members do not "
                        f"stand together"
                    )
                if len(clips) >= most:
                    raise UserError(f"{path}: more than {most} clips, which no shard of ours has")
                seen.add(key)
                clips.append(TarClip(key))
            if member in clips[-1].members:
                raise UserError(f"{path}: '{info.name}' appears twice: duplicate member")
            clips[-1].members[member] = (info.offset_data, info.size)
    if clips:
        _require_whole(path, clips, needed)
    _check_end(path, end)
    return clips


def _entries(path: Path, file: BinaryIO) -> Iterator[tarfile.TarInfo]:
    """Yield a tar's headers of one block each; `tarfile.open` would read longer ones of any stated size."""
    at = 0
    while (block := file.read(tarfile.BLOCKSIZE)).strip(b"\0"):
        try:
            info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        except (tarfile.TarError, ValueError) as error:
            last = f"in the header at byte {at}: {error}"
            raise UserError(f"{path}: not a readable tar file ({last}); convert the dataset again") from None
        info.offset_data = at + tarfile.BLOCKSIZE
        yield info
        at = info.offset_data + -(-info.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
        file.seek(at)


def _checked_name(path: Path, info: tarfile.TarInfo, column: str) -> tuple[str, str]:
    """(key, member) of one entry, refused when it is anything but a plain file with a harmless name."""
    name = info.name
    if name.startswith(".") or {"/", "\\", ":", "\0"} & set(name):
        raise UserError(f"{path}: {name!r} is a path (path traversal); shards hold plain names only")
    if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or info.size < 0:
        raise UserError(f"{path}: {name!r} is a link, folder or device; shards hold plain files only")
    key, _, member = name.partition(".")
    known = [column] if column else MEMBERS
    if member not in known:
        discover()  # a worker may not have met the modalities of other packages
    if member not in known:
        raise UserError(f"{path}: {name!r} is not a known member; known: {', '.join(known)}")
    return key, member


def _require_whole(path: Path, clips: list[TarClip], needed: set[str]) -> None:
    clip = clips[-1]
    missing = needed - clip.members.keys()
    if missing:
        last = f" (truncated? the last whole key is '{clips[-2].key}')" if len(clips) > 1 else ""
        raise UserError(f"{path}: missing field: key '{clip.key}' has no {sorted(missing)[0]}{last}")


def _check_end(path: Path, end: int) -> None:
    """Refuse anything but zeros after the last entry, which tar readers would ignore."""
    with path.open("rb") as file:
        file.seek(end)
        while block := file.read(1 << 20):
            if block.count(0) != len(block):
                raise UserError(
                    f"{path}: the data after byte {end} are no tar entries: damaged, or two archives in one "
                    f"file"
                )


def npy_from_bytes(raw: bytes, where: str) -> NDArray[np.floating]:
    """The floats of a whole .npy member, a view of its bytes; `UserError` for anything else."""
    header = read_npy_header(io.BytesIO(raw), where, len(raw))
    if header.dtype.kind != "f":
        raise UserError(f"{where}: holds {header.dtype} values, floats only are accepted")
    if header.fortran and len(header.shape) > 1:
        raise UserError(f"{where}: in Fortran order; write it in C order")
    return np.frombuffer(raw, header.dtype, offset=header.start).reshape(header.shape)
