"""Reading a shard's directory without trusting it.

Only plain files of known member names, contiguous per key, are accepted; a path separator, a link, a device,
a repeated or interleaved key or an object array stops the read with the shard's and the member's name.
Nothing is ever extracted, and nothing is unpickled.
"""

from __future__ import annotations

import io
import tarfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.sample import MEMBERS

NPY_HEADER_LIMIT = 4096


@dataclass
class TarClip:
    """One key of a shard: member name -> (offset of its content, size), both in bytes."""

    key: str
    members: dict[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class NpyHeader:
    """What an .npy member says about itself; `data` is the byte, from its start, where the values begin."""

    shape: tuple[int, ...]
    dtype: np.dtype
    data: int


def scan_tar(path: Path) -> list[TarClip]:
    """The clips of a shard in the order they stand; `UserError` names what is wrong with the file."""
    clips: list[TarClip] = []
    seen: set[str] = set()
    size = path.stat().st_size
    try:
        with tarfile.open(path, mode="r:") as archive:
            for info in archive:
                key, member = _checked_name(path, info)
                if info.offset_data + info.size > size:
                    raise UserError(f"{path}: truncated inside '{info.name}'; convert the dataset again")
                if not clips or clips[-1].key != key:
                    if key in seen:
                        raise UserError(f"{path}: the members of key '{key}' do not stand together")
                    seen.add(key)
                    clips.append(TarClip(key))
                if member in clips[-1].members:
                    raise UserError(f"{path}: '{info.name}' appears twice")
                clips[-1].members[member] = (info.offset_data, info.size)
    except (tarfile.TarError, EOFError, OSError) as error:
        raise UserError(f"{path}: not a readable tar file ({error}); convert the dataset again") from None
    for clip in clips:
        missing = {"motion.npy", "meta.json"} - clip.members.keys()
        if missing:
            raise UserError(f"{path}: key '{clip.key}' has no {sorted(missing)[0]}")
    return clips


def _checked_name(path: Path, info: tarfile.TarInfo) -> tuple[str, str]:
    """(key, member) of one entry, refused when it is anything but a plain file with a name we write."""
    if not info.isreg():
        raise UserError(f"{path}: '{info.name}' is a link, folder or device; shards hold plain files only")
    if "/" in info.name or "\\" in info.name or info.name.startswith("."):
        raise UserError(f"{path}: '{info.name}' is a path; shards hold plain names only")
    key, _, member = info.name.partition(".")
    if member not in MEMBERS:
        raise UserError(f"{path}: '{info.name}' is not a known member; known: {', '.join(MEMBERS)}")
    return key, member


def npy_from_bytes(raw: bytes, where: str) -> NDArray[np.floating]:
    """The array of a whole .npy member, a view of its bytes; `UserError` also when it is cut."""
    header = read_npy_header(io.BytesIO(raw), where)
    if header.data + int(np.prod(header.shape)) * header.dtype.itemsize != len(raw):
        raise UserError(f"{where}: the array is cut short or too long")
    return np.frombuffer(raw, header.dtype, offset=header.data).reshape(header.shape)


def read_npy_header(file: BinaryIO, where: str) -> NpyHeader:
    """Parse the header at the file's position; object arrays, Fortran order and non-floats are refused."""
    start = file.tell()
    head = io.BytesIO(file.read(NPY_HEADER_LIMIT))
    try:
        version = npy_format.read_magic(head)
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        shape, fortran, dtype = read(head)
    except ValueError as error:
        raise UserError(f"{where}: not a valid .npy array ({error})") from None
    if dtype.hasobject or dtype.kind != "f":
        raise UserError(f"{where}: holds {dtype} values, floats only are accepted")
    if fortran and len(shape) > 1:
        raise UserError(f"{where}: in Fortran order; write it in C order")
    file.seek(start)
    return NpyHeader(tuple(shape), dtype, head.tell())
