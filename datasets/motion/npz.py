"""Reading .npz files from outside: never a pickle, never more memory than allowed, and headers without data.

`np.load` would do for trusted files. A planner must know shape and type of the arrays of thousands of clips,
though, and a file may state any size, so headers are read first and checked against the archive's own list.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError

MAX_BYTES = 2**30
"""Largest array read by default: an hour at 200 frames a second of 156 doubles is 0.9 GB."""


@dataclass(frozen=True)
class ArrayHeader:
    """What the header of an array states."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    start: int
    """Bytes before the data."""

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


class NpzFile:
    """The arrays of one .npz file, by name. `UserError` names file and array for everything that is wrong.

    `label` stands for the path in these sentences, where they go into a manifest.
    """

    def __init__(self, path: Path, label: str | None = None) -> None:
        self.label = str(path) if label is None else label
        try:
            self._zip = zipfile.ZipFile(path)
        except OSError as error:
            raise UserError(f"{self.label}: cannot be read ({error.strerror or error})") from None
        except (zipfile.BadZipFile, NotImplementedError, ValueError):
            raise UserError(f"{self.label}: not an .npz file, or cut off") from None
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
            version = npy_format.read_magic(stream)
            if version not in ((1, 0), (2, 0)):
                raise UserError(f"{self.label}: array '{name}' has the unknown .npy version {version}")
            first = version == (1, 0)
            read = npy_format.read_array_header_1_0 if first else npy_format.read_array_header_2_0
            shape, _, dtype = read(stream)
            if any(count < 0 for count in shape):
                raise ValueError(f"a negative size in {list(shape)}")
            header = ArrayHeader(shape, dtype, stream.tell())
        if dtype.hasobject:
            raise UserError(
                f"{self.label}: array '{name}' holds Python objects (a pickle), which can run code and is "
                f"never read; save it as plain numbers or text"
            )
        stated = self._zip.getinfo(f"{name}.npy").file_size
        if stated != header.start + header.size:
            raise UserError(
                f"{self.label}: array '{name}' of shape {list(shape)} needs {header.start + header.size} "
                f"bytes, the file holds {stated}"
            )
        return header

    def array(self, name: str, *, limit: int = MAX_BYTES) -> NDArray[np.floating]:
        header = self.header(name)
        if header.size > limit:
            raise UserError(
                f"{self.label}: array '{name}' of shape {list(header.shape)} takes {header.size:,} bytes; "
                f"more than {limit:,} are not read"
            )
        with self._open(name) as stream:
            return np.asarray(npy_format.read_array(stream, allow_pickle=False))

    def numbers(self, name: str, *, limit: int = MAX_BYTES) -> NDArray[np.float64]:
        """A float or integer array, as native float64; floats stay exact whatever their byte order."""
        kind = self.header(name).dtype
        if kind.kind not in "fiu":
            raise UserError(f"{self.label}: array '{name}' has type {kind}, not numbers")
        return self.array(name, limit=limit).astype(np.float64, copy=False)

    @contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        if name not in self.names:
            raise UserError(f"{self.label}: no array '{name}'; there are {', '.join(sorted(self.names))}")
        try:
            with self._zip.open(f"{name}.npy") as stream:
                yield stream
        except UserError:
            raise
        except (NotImplementedError, RuntimeError) as error:  # encrypted, or an unknown compression
            raise UserError(f"{self.label}: array '{name}' cannot be unpacked ({error})") from None
        except Exception as error:  # zip, zlib and numpy's header parser fail in many ways on broken bytes
            reason = " ".join(str(error).split())[:120]
            raise UserError(f"{self.label}: array '{name}' is damaged ({reason})") from None
