"""AIST++ annotations are pickles, which can run any code. This is the one place that reads a pickle.

Four fences, each enough against the usual attack:
- only the opcodes that containers, numbers, text and numpy arrays need; none that names a class to build;
- only the globals that numpy's own arrays name (`ALLOWED`); anything else is refused by its name;
- even these are not numpy's: stand-ins collect what a file says about an array, and the array is built here,
  from plain numbers whose bytes must have exactly the size that the shape demands. So no object arrays, no
  huge shape without data, and nothing of the running program that a file could change;
- limits on the file's size, on its opcodes and on its memo.
Only `smpl_poses`, `smpl_trans` and `smpl_scaling` are used.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.arrays import check_values
from motionloom.datasets.schema import UserError

POSE_WIDTH = 72
"""24 joints x axis-angle."""

MAX_BYTES = 16 * 2**20
"""The longest dances take about 1 MB."""

MAX_OPCODES, MAX_CALLS = 1000, 64
"""A real file has about 150 instructions, 20 of them calls. A call can copy the bytes of the whole file once:
together with `MAX_BYTES` this bounds memory to 1 GiB.
"""

MAX_RADIANS = 100.0
MAX_METRES = 1000.0
"""Beyond these a value is damage, not a pose."""

_OPCODE_NAMES = """
PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 FLOAT BINFLOAT
STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES
SHORT_BINBYTES BINBYTES8 EMPTY_DICT DICT SETITEM SETITEMS EMPTY_LIST LIST APPEND APPENDS EMPTY_TUPLE
TUPLE TUPLE1 TUPLE2 TUPLE3 PUT BINPUT LONG_BINPUT MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL
REDUCE BUILD
"""
_OPCODES = frozenset(_OPCODE_NAMES.split())

_CODES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")
_KINDS = {code: np.dtype(code) for code in _CODES}


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
    value = data[key]
    if isinstance(value, float | int):
        value = np.asarray(value, dtype=np.float64)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise UserError(f"{name}: {key} is not an array of numbers")
    return value


def load_aist_pickle(path: Path, name: str | None = None) -> dict[str, object]:
    """The dict of a pickle of plain values and numpy arrays; `UserError` naming the file otherwise."""
    name = str(path) if name is None else name
    if not path.is_file():
        raise UserError(f"{name}: no such file")
    size = path.stat().st_size
    if not 0 < size <= MAX_BYTES:
        raise UserError(f"{name}: {size} bytes; an annotation has between 1 and {MAX_BYTES}")
    raw = path.read_bytes()
    try:
        _check_opcodes(raw)
        return _plain(_Restricted(io.BytesIO(raw), encoding="latin1").load())
    except _Refused as error:
        raise UserError(f"{name}: refused, {error}") from None
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes make pickle raise nearly anything
        raise UserError(
            f"{name}: not a whole pickle, cut short or damaged ({type(error).__name__}: {str(error)[:120]})"
        ) from None


def _plain(data: object) -> dict[str, object]:
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise _Refused(f"it holds a {type(data).__name__}, not a dict of named values")
    return {key: value.values() if isinstance(value, _Array) else value for key, value in data.items()}


class _Refused(Exception):  # noqa: N818 (a decision, not an error)
    """What a file asks for and is refused."""


def _check_opcodes(raw: bytes) -> None:
    calls = 0
    for number, (opcode, argument, _) in enumerate(pickletools.genops(raw)):
        if number >= MAX_OPCODES:
            raise _Refused(f"more than {MAX_OPCODES} pickle instructions")
        if opcode.name not in _OPCODES:
            shown = f" {argument!r:.80}" if argument is not None else ""
            raise _Refused(f"pickle instruction {opcode.name}{shown}")
        calls += opcode.name in ("REDUCE", "BUILD")
        if calls > MAX_CALLS:
            raise _Refused(f"more than {MAX_CALLS} arrays and other objects")
        if opcode.name in ("PUT", "LONG_BINPUT") and (argument or 0) > MAX_OPCODES:
            raise _Refused(f"memo place {argument}")  # the unpickler would make room for all before it


class _DType:
    """Stand-in for `numpy.dtype`: a plain number type, without objects, fields or text."""

    __slots__ = ("found",)

    def __init__(self, code: object, *_: object) -> None:
        if not isinstance(code, str) or code not in _KINDS:
            raise _Refused(f"array type {code!r:.40}; plain numbers only")
        self.found = _KINDS[code]

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple):
            raise _Refused("an array without a state")
        order = state[1]
        if order not in ("<", ">", "|", "=") or any(part is not None for part in state[2:5]):
            raise _Refused("an array type with fields")
        self.found = self.found.newbyteorder(order)


class _Array:
    """Stand-in for `numpy.ndarray`: collects type, shape and bytes, and checks that they fit."""

    __slots__ = ("found",)

    def __init__(self) -> None:
        self.found: NDArray[np.floating] | None = None

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple):
            raise _Refused("an array without a state")
        _, shape, kind, fortran, raw = state
        if not isinstance(kind, _DType) or not isinstance(shape, tuple) or len(shape) > 3:
            raise _Refused("an array without a plain type and shape")
        if any(type(size) is not int or size < 0 for size in shape):
            raise _Refused(f"array shape {shape!r:.60}")
        self.found = _from_bytes(raw, kind, shape, "F" if fortran else "C")

    def values(self) -> NDArray[np.floating]:
        if self.found is None:
            raise _Refused("an array that is named but not filled")
        return self.found


def _from_bytes(
    raw: object, kind: _DType, shape: tuple[int, ...], order: Literal["C", "F"]
) -> NDArray[np.floating]:
    if isinstance(raw, str):
        raw = raw.encode("latin1")  # pickles of Python 2 keep bytes as text
    if not isinstance(raw, bytes):
        raise _Refused("an array of Python objects")
    expected = kind.found.itemsize
    for size in shape:
        expected *= size
    if len(raw) != expected:
        raise _Refused(f"an array of shape {list(shape)} with {len(raw)} bytes instead of {expected}")
    native = kind.found.newbyteorder("=")
    made: NDArray[np.floating] = np.frombuffer(raw, kind.found).reshape(shape, order=order).astype(native)
    return made


class _Callable:
    """An allowed global: it can be called, and nothing else about it can be changed."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., object]) -> None:
        self._make = make

    def __call__(self, *arguments: object) -> object:
        return self._make(*arguments)

    def __setstate__(self, state: object) -> None:
        raise _Refused("an attempt to change a function")


def _reconstruct(kind: object, *_: object) -> _Array:
    if kind is not _NDARRAY:
        raise _Refused("an array of another class than numpy.ndarray")
    return _Array()


def _encode(text: object, encoding: object = None) -> bytes:
    """`_codecs.encode` as Python 2's protocols use it for bytes; other codecs could unpack or loop."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _Refused(f"_codecs.encode with {encoding!r:.40}")
    return text.encode("latin1")


def _scalar(kind: object, raw: object) -> float:
    if not isinstance(kind, _DType):
        raise _Refused("a number without a plain type")
    return float(_from_bytes(raw, kind, (), "C"))


def _no_call(*_: object) -> object:
    raise _Refused("a call of numpy.ndarray")


_NDARRAY = _Callable(_no_call)
_NUMPY = {"_reconstruct": _Callable(_reconstruct), "scalar": _Callable(_scalar)}
ALLOWED: dict[str, object] = {
    "numpy.ndarray": _NDARRAY,
    "numpy.dtype": _Callable(_DType),
    "_codecs.encode": _Callable(_encode),
    **{f"numpy.core.multiarray.{name}": made for name, made in _NUMPY.items()},
    **{f"numpy._core.multiarray.{name}": made for name, made in _NUMPY.items()},
}
"""Every global that a file may name, and what it gets instead."""


class _Restricted(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> object:
        found = ALLOWED.get(f"{module}.{name}")
        if found is None:
            raise _Refused(f"the file asks for '{module}.{name}', which an annotation never needs")
        return found
