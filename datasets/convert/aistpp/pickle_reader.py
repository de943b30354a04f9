"""AIST++ annotations are pickles, which can run any code. This is the one place that reads a pickle.

`pickle.Unpickler` does the reading; its `find_class` knows only the names with which numpy pickles arrays
(`ALLOWED`, protocols 0 to 5) and gives an inert record for each, so nothing is called while a file is read.
The three arrays that are used are then built here, of plain numbers whose bytes must have exactly the size
that the shape demands: no object arrays, no huge shape without data. Memory is bounded by the file's size.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.arrays import check_values
from motionloom.datasets.schema import UserError

POSE_WIDTH = 72
"""24 joints x axis-angle."""

MAX_BYTES = 16 * 2**20
"""The longest dances take about 1 MB."""

MAX_OPCODES = 1000
"""A real file has about 150 instructions."""

ALLOWED = frozenset(
    {
        "numpy.ndarray",
        "numpy.dtype",
        "numpy.core.multiarray._reconstruct",
        "numpy.core.multiarray.scalar",
        "numpy.core.numeric._frombuffer",  # protocol 5
        "_codecs.encode",  # bytes in the protocols of Python 2
    }
)
"""Every global that a file may name."""

MAX_RADIANS = 100.0
MAX_METRES = 1000.0
"""Beyond these a value is damage, not a pose."""


@dataclass(frozen=True)
class AistMotion:
    """One annotated sequence at 60 fps."""

    poses: NDArray[np.float32]
    """[T, 72] axis-angle of 24 SMPL joints, radians."""
    trans: NDArray[np.float32]
    """[T, 3] in the source's own unit; metres after division by `scaling`."""
    scaling: float
    """Positive; about 94 in the release."""

    def metres(self) -> NDArray[np.float64]:
        """SMPL's translation [T, 3] in metres."""
        return np.asarray(self.trans / np.float64(self.scaling), dtype=np.float64)


def read_aist_motion(path: Path, name: str | None = None) -> AistMotion:
    """One `motions/*.pkl`; `UserError` naming the file, and the key or the refused global.

    `name` stands for the path in errors that go into a manifest.
    """
    name = str(path) if name is None else name
    data = load_aist_pickle(path, name)
    poses = _array(name, data, "smpl_poses", POSE_WIDTH)
    trans = _array(name, data, "smpl_trans", 3)
    if len(poses) != len(trans):
        raise UserError(f"{name}: {len(poses)} frames of smpl_poses, but {len(trans)} of smpl_trans")
    scaling = np.atleast_1d(_values(name, data, "smpl_scaling"))
    if scaling.size != 1:
        raise UserError(f"{name}: smpl_scaling has {scaling.size} values, not 1")
    factor = float(scaling.reshape(-1)[0])
    if not np.isfinite(factor) or factor <= 0:
        raise UserError(f"{name}: smpl_scaling is {factor:g}; it must be a positive number")
    check_values(poses, MAX_RADIANS, f"{name}: smpl_poses")
    check_values(trans / factor, MAX_METRES, f"{name}: smpl_trans")
    return AistMotion(poses.astype(np.float32), trans.astype(np.float32), factor)


def _array(name: str, data: dict[str, object], key: str, width: int) -> NDArray[np.float64]:
    values = _values(name, data, key)
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise UserError(f"{name}: {key} is {list(values.shape)}, not [T, {width}]")
    return values.astype(np.float64)


def _values(name: str, data: dict[str, object], key: str) -> NDArray[np.floating]:
    if key not in data:
        raise UserError(f"{name}: no key '{key}'")
    try:
        return _decode_numbers(data[key])
    except (_Refused, ValueError, OverflowError) as error:  # not latin1, or an integer beyond float64
        raise UserError(f"{name}: {key} is not an array of numbers: {error}") from None


def load_aist_pickle(path: Path, name: str | None = None) -> dict[str, object]:
    """Return the dict of a pickle, arrays as undecoded records; `UserError` naming the file otherwise."""
    name = str(path) if name is None else name
    if not path.is_file():
        raise UserError(f"{name}: no such file")
    size = path.stat().st_size
    if not 0 < size <= MAX_BYTES:
        raise UserError(f"{name}: {size} bytes; an annotation has between 1 and {MAX_BYTES}")
    raw = path.read_bytes()
    try:
        _require_bounded(raw)
        data = _Unpickler(io.BytesIO(raw), encoding="latin1").load()
        if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
            raise _Refused(f"it holds a {type(data).__name__}, not a dict of named values")
        return data
    except _Refused as error:
        raise UserError(f"{name}: refused, {error}") from None
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes make pickle raise nearly anything
        raise UserError(
            f"{name}: not a whole pickle, cut short or damaged ({type(error).__name__}: {str(error)[:120]})"
        ) from None


class _Refused(Exception):  # noqa: N818 (a decision, not an error)
    """A pickle asks for something that an annotation never needs."""


def _require_bounded(raw: bytes) -> None:
    """Refuse what makes the unpickler itself take memory; `genops` compares stated lengths with the data."""
    for number, (opcode, argument, _) in enumerate(pickletools.genops(raw)):
        if number >= MAX_OPCODES:
            raise _Refused(f"more than {MAX_OPCODES} pickle instructions")
        # Python before 3.14 makes room for all memo places below the one that is named (gh-115952).
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and (argument or 0) > MAX_OPCODES:
            raise _Refused(f"memo place {argument}")


class _Record:
    """A name in a pickle, what it is called with, and the state of the result; nothing is called."""

    __match_args__ = ("name", "arguments", "state")

    def __init__(self, name: str, arguments: tuple[object, ...] = ()) -> None:
        self.name, self.arguments = name, arguments
        self.state: object = None

    def __call__(self, *arguments: object) -> _Record:
        return _Record(self.name, arguments)

    def __setstate__(self, state: object) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> object:
        # numpy 2 renamed numpy.core.
        asked = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
        if asked not in ALLOWED:
            raise _Refused(f"the file asks for '{module}.{name}', which an annotation never needs")
        return _Record(asked)


def _decode_numbers(value: object) -> NDArray[np.floating]:
    """Return the array or number that a record describes, as numpy's own pickling would."""
    match value:
        case float() | int():
            return np.asarray(value, dtype=np.float64)
        case _Record("numpy.core.multiarray._reconstruct", _, (_, shape, kind, fortran, data)):
            order = "F" if fortran else "C"
        case _Record("numpy.core.numeric._frombuffer", (data, kind, shape, order)):
            pass
        case _Record("numpy.core.multiarray.scalar", (kind, data)):
            shape, order = (), "C"
        case _:
            raise _Refused("of another kind")
    sizes = shape if isinstance(shape, tuple) and len(shape) <= 3 else (-1,)
    if any(type(size) is not int or not 0 <= size <= MAX_BYTES for size in sizes):
        raise _Refused(f"array shape {shape!r:.60}")
    dtype, raw = _decode_dtype(kind), _decode_bytes(data)
    expected = math.prod(sizes) * dtype.itemsize
    if len(raw) != expected:
        raise _Refused(f"an array of shape {list(sizes)} with {len(raw)} bytes instead of {expected}")
    values = np.frombuffer(raw, dtype).reshape(sizes, order="F" if order == "F" else "C")
    return np.asarray(values, dtype=dtype.newbyteorder("="))


def _decode_dtype(kind: object) -> np.dtype[np.floating]:
    """Return a type of plain numbers; objects, fields, complex numbers and text are refused."""
    match kind:
        case _Record(
            "numpy.dtype", (str(code), *_), (_, "<" | ">" | "|" | "=" as order, None, None, None, *_)
        ):
            if code in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"):
                return np.dtype(code).newbyteorder(order)
    raise _Refused("array type that is no plain number")


def _decode_bytes(data: object) -> bytes | bytearray:
    match data:
        case _Record("_codecs.encode", (str(text), "latin1"), None) | str(text):
            return text.encode("latin1")
        case bytes() | bytearray():
            return data
    raise _Refused("an array without its bytes")
