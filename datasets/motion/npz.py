"""Reading .npy and .npz from outside: never a pickle, never more memory than the file holds or is allowed.

`np.load` would do for trusted files. A planner must know shape and type of the arrays of thousands of clips,
though, and a file may state any size, so headers are read first and compared with the bytes that are there.
"""

from __future__ import annotations

import io
import math
import mmap
import os
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, Self

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import open_plain, require_plain

MAX_BYTES = 2**30
"""Largest array read by default: an hour at 200 frames a second of 156 doubles is 0.9 GB."""


# numpy warns of each file that Python 2 wrote, which is nothing to do about.
warnings.filterwarnings("ignore", "Reading `.npy` or `.npz` file required additional header parsing")

_SPARE, _PACKED = 2**25, 5
"""Bytes that any array may take in memory, and more for each of its bytes in the file: motion packs to a half
and float32 doubles as float64. What is packed tighter says nothing, or is a bomb."""


@dataclass(frozen=True)
class ArrayHeader:
    """Shape and type that an array's header states."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    start: int
    """Bytes in front of the data."""
    fortran: bool = False

    @property
    def end(self) -> int:
        """Bytes of the whole file."""
        return self.start + math.prod(self.shape) * self.dtype.itemsize


def read_npy_header(stream: IO[bytes], where: str, size: int) -> ArrayHeader:
    """Header of the .npy file of `size` bytes that begins at the stream's position; reads no data.

    `UserError` beginning with `where` for anything else, for Python objects, and for a size that does not fit
    shape and type.
    """
    begin = stream.tell()
    try:
        version = npy_format.read_magic(stream)
        # Version 3 differs only in the names of record fields, which no motion file has.
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except OSError:
        raise
    except Exception as error:  # numpy's header parser fails in many ways on broken text
        reason = " ".join(str(error).split())[:120]
        raise UserError(f"{where}: not an .npy file, or cut within its header ({reason})") from None
    if dtype.hasobject:
        raise UserError(
            f"{where}: object array (a pickle), which would run code when read; save plain numbers or text"
        )
    counted = all(type(count) is int and count >= 0 for count in shape)
    # numpy counts no zero: nothing at all times too much is too much.
    if not counted or math.prod(count or 1 for count in shape) * dtype.itemsize >= 2**62:
        raise UserError(f"{where}: the header states the size {list(shape)}")
    header = ArrayHeader(shape, dtype, stream.tell() - begin, fortran)
    if header.end != size:
        what = "truncated array" if size < header.end else "more data than the header states"
        expected = header.end - header.start
        actual = size - header.start
        raise UserError(f"{where}: {what}: {expected} bytes expected for {list(shape)}, {actual} found")
    return header


def npy_header(path: Path, where: str, most: float = math.inf) -> ArrayHeader:
    """Header of a plain .npy file of at most `most` bytes; `UserError` beginning with `where` otherwise."""
    try:
        with open_plain(path, where) as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0 or size > most:
                much = f"{size:,} bytes; at most {most:,} are read" if size else "empty file"
                raise UserError(f"{where}: {much}")
            return read_npy_header(file, where, size)
    except OSError as error:
        raise UserError(f"{where}: cannot be read ({error.strerror or error})") from None


class _Mapped(np.memmap):
    """A whole file's array, which another process is sent by its name; a part of it is sent as it is."""

    path: Path | None = None

    def __reduce__(self) -> Any:
        return super().__reduce__() if self.path is None else (map_npy, (self.path,))


def map_npy(path: Path) -> NDArray[Any]:
    """The array of a plain .npy file, read from the disk where it is looked at; `UserError` for any other."""
    header = npy_header(path, str(path))
    if not math.prod(header.shape):  # nothing cannot be mapped
        return np.empty(header.shape, header.dtype)
    order: Literal["C", "F"] = "F" if header.fortran else "C"
    found = _Mapped(path, header.dtype, "r", header.start, header.shape, order)
    found.path = path
    return found


class NpzFile:
    """The arrays of one .npz file, by name. `UserError` names file and array for everything that is wrong.

    `label` stands for the path in these sentences, where they go into a manifest.
    """

    def __init__(self, path: Path | IO[bytes], label: str | None = None) -> None:
        self.label = str(path) if label is None else label
        try:
            if isinstance(path, Path):
                require_plain(path, self.label)
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            system = error.__context__ or error  # zipfile takes a disk that cannot be read for another file
            if isinstance(system, OSError):
                raise UserError(f"{self.label}: cannot be read ({system.strerror or system})") from None
            raise UserError(f"{self.label}: not an .npz file, or cut off") from None
        self._map: mmap.mmap | None = None
        names = [name for name in self._zip.namelist() if name.endswith(".npy")]
        self.names = frozenset(name.removesuffix(".npy") for name in names)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._zip.close()

    def header(self, name: str) -> ArrayHeader:
        """Shape and type of an array; reads no data, but finds sizes that do not fit and Python objects."""
        with self._open(name) as stream:
            return read_npy_header(
                stream, f"{self.label}: array '{name}'", self._zip.getinfo(f"{name}.npy").file_size
            )

    def mapped(self, name: str, *, limit: int = MAX_BYTES) -> NDArray[Any]:
        """An array as it lies in the file, read-only and in memory that all processes share; `array` for one
        that is packed. Its bytes are compared with their checksum."""
        info = self._zip.NameToInfo.get(f"{name}.npy")
        file: Any = self._zip.fp
        if info is None or info.compress_type != zipfile.ZIP_STORED or isinstance(file, io.BytesIO):
            return self.array(name, limit=limit)
        header = self._header_within(name, limit)
        if not math.prod(header.shape):
            return np.empty(header.shape, header.dtype)
        if self._map is None:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        # Before the content stand 30 bytes, of which the last four say how long name and extra field are.
        lengths = struct.unpack_from("<HH", self._map, info.header_offset + 26)
        start = info.header_offset + 30 + sum(lengths)
        content = memoryview(self._map)[start : start + info.file_size]
        if len(content) != header.end or zlib.crc32(content) != info.CRC:
            raise UserError(f"{self.label}: array '{name}' is damaged (Bad CRC-32)")
        order: Literal["C", "F"] = "F" if header.fortran else "C"
        return np.ndarray(header.shape, header.dtype, self._map, start + header.start, order=order)

    def _header_within(self, name: str, limit: int, itemsize: int = 0) -> ArrayHeader:
        """`header` of an array that takes no more memory than it may."""
        header = self.header(name)
        size = header.start + math.prod(header.shape) * max(header.dtype.itemsize, itemsize)
        most = min(limit, _SPARE + _PACKED * self._zip.getinfo(f"{name}.npy").compress_size)
        if size > most:
            raise UserError(
                f"{self.label}: array '{name}' of shape {list(header.shape)} takes {size:,} bytes; more than "
                f"{most:,} are not read"
            )
        return header

    def array(self, name: str, *, limit: int = MAX_BYTES, itemsize: int = 0) -> NDArray[Any]:
        """An array; `itemsize` is what a value takes once it is converted, where that is more."""
        self._header_within(name, limit, itemsize)
        # The stream is opened anew: the header has been read off the first one, and zips do not seek cheaply.
        with self._open(name) as stream:
            found = np.asarray(npy_format.read_array(stream, allow_pickle=False))
        if found.dtype.kind == "U" and found.nbytes:  # numpy takes any numbers for letters
            letters = np.frombuffer(found.tobytes(), np.dtype("u4").newbyteorder(found.dtype.byteorder))
            if letters.max() > sys.maxunicode:
                raise UserError(f"{self.label}: array '{name}' is damaged (text of no letters)")
        return found

    def numbers(self, name: str, *, limit: int = MAX_BYTES) -> NDArray[np.float64]:
        """A float or integer array, as native float64; floats stay exact whatever their byte order."""
        kind = self.header(name).dtype
        if kind.kind not in "fiu":
            raise UserError(f"{self.label}: array '{name}' has type {kind}, not numbers")
        with np.errstate(all="ignore"):  # what is not finite is refused where its meaning is known
            return self.array(name, limit=limit, itemsize=8).astype(np.float64, copy=False)

    @contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        if name not in self.names:
            raise UserError(f"{self.label}: no array '{name}'; there are {', '.join(sorted(self.names))}")
        try:
            with self._zip.open(f"{name}.npy") as stream:
                yield stream
        except UserError:
            raise
        except Exception as error:  # zip, zlib and numpy's header parser fail in many ways on broken bytes
            reason = " ".join(str(error).split())[:120]
            raise UserError(f"{self.label}: array '{name}' is damaged ({reason})") from None
