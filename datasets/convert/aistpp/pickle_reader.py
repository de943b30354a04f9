"""AIST++ annotations are pickles, which can run any code. This is the one place that reads a pickle.

`pickle.Unpickler` does the reading; its `find_class` knows only the names with which numpy pickles arrays
(`ALLOWED`, protocols 0 to 5) and gives an inert record for each, so nothing is called while a file is read.
The three arrays that are used are then built here, of plain numbers whose bytes must have exactly the size
that the shape demands: no object arrays, no huge shape without data. Memory is bounded by the file's size.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import read_plain
from motionloom.datasets.convert.common.arrays import check_values

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
        "numpy.core.multiarray.scalar",  # of values that are not used
        "numpy.core.numeric._frombuffer",  # protocol 5
        "_codecs.encode",  # bytes in the protocols of Python 2
    }
)
"""Every global that a file may name."""
_PLAIN = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")

MAX_RADIANS = 100.0
MAX_METRES = 1000.0
"""Beyond these a value is damage, not a pose."""


def read_aist_motion(path: Path, name: str = "") -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Poses [T, 72] (axis-angle of 24 SMPL joints, radians) and SMPL's translation [T, 3] in metres of one
    `motions/*.pkl` at 60 fps; `UserError` beginning with `name` (default: the path), with the key or the
    refused global.
    """
    name = name or str(path)
    try:
        raw = read_plain(path, MAX_BYTES, name)
        _require_bounded(raw)
        data = _Unpickler(io.BytesIO(raw), encoding="latin1").load()
        poses = _frames(data, "smpl_poses", POSE_WIDTH)
        trans = _frames(data, "smpl_trans", 3)
        scaling = _numbers_of(data, "smpl_scaling").reshape(-1)
        if len(poses) != len(trans):
            raise _Refused(f"{len(poses)} frames of smpl_poses, but {len(trans)} of smpl_trans")
        if scaling.size != 1 or not 0 < scaling[0] < np.inf:
            raise _Refused(f"smpl_scaling is {scaling[:3].tolist()}; it must be one positive number")
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{name}: cannot read ({error.strerror})") from None
    except _Refused as error:
        raise UserError(f"{name}: refused, {error}") from None
    except Exception as error:  # damaged bytes make pickle raise nearly anything, also MemoryError at once
        raise UserError(
            f"{name}: not a whole pickle, cut short or damaged ({type(error).__name__}: {str(error)[:120]})"
        ) from None
    check_values(poses, MAX_RADIANS, f"{name}: smpl_poses")
    check_values(trans / float(scaling[0]), MAX_METRES, f"{name}: smpl_trans")
    return poses.astype(np.float32), trans.astype(np.float32) / np.float64(scaling[0])


def _frames(data: object, key: str, width: int) -> NDArray[np.float64]:
    values = _numbers_of(data, key)
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise _Refused(f"{key} is {list(values.shape)}, not [T, {width}]")
    with np.errstate(invalid="ignore"):  # a NaN of four bytes; it is refused with the values
        return values.astype(np.float64)


def _numbers_of(data: object, key: str) -> NDArray[np.floating]:
    if not isinstance(data, dict) or key not in data:
        raise _Refused(f"no key '{key}'" if isinstance(data, dict) else f"a {type(data).__name__}, no dict")
    try:
        return _decode_numbers(data[key])
    except (_Refused, ValueError, OverflowError) as error:  # not latin1, or an integer beyond float64
        raise _Refused(f"{key} is not an array of numbers: {error}") from None


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
        self.name = name
        self.arguments = arguments
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
    """The array or number of a record; objects, fields, complex numbers and text are refused."""
    match value:
        case float() | int():
            return np.asarray(value, dtype=np.float64)
        case _Record("numpy.core.multiarray._reconstruct", _, (_, tuple(shape), kind, fortran, data)):
            order = "F" if fortran else "C"
        case _Record("numpy.core.numeric._frombuffer", (data, kind, tuple(shape), order)):
            pass
        case _:
            raise _Refused("of another kind")
    match kind:
        case _Record(
            "numpy.dtype", (str(code), *_), (_, "<" | ">" | "|" | "=" as ends, None, None, None, *_)
        ) if code in _PLAIN:
            dtype = np.dtype(code).newbyteorder(ends)
        case _:
            raise _Refused("array type that is no plain number")
    match data:
        case _Record("_codecs.encode", (str(text), "latin1"), None) | str(text):
            raw: bytes | bytearray = text.encode("latin1")
        case bytes() | bytearray():
            raw = data
        case _:
            raise _Refused("an array without its bytes")
    if any(type(size) is not int or size < 0 for size in shape):  # -1 would be whatever fits
        raise _Refused(f"array shape {shape!r:.60}")
    values = np.frombuffer(raw, dtype).reshape(shape, order="F" if order == "F" else "C")
    return np.asarray(values, dtype=dtype.newbyteorder("="))
