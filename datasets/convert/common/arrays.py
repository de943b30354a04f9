"""Reading of `.npy` files from outside: nothing is run, guessed or half read.

A file becomes an array only if it is whole, [T, width], float32 or float64, finite and within the caller's
range. Big-endian and Fortran-ordered files are plain storage variants and are converted. Everything else is
a `UserError` that names the file and the reason: object arrays (pickles in disguise), cut files, stray or
missing axes. A transposed array is refused, not turned: [322, 322] could not be told apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.memory import recall
from motionloom.datasets.motion.npz import MAX_BYTES, ArrayHeader, npy_header

Limit = float | NDArray[np.float64]


def load_array(
    path: Path, *, width: int | tuple[int, ...], name: str | None = None, limit: Limit | None = None
) -> NDArray[np.floating]:
    """The array [T, width] of an `.npy` file, T >= 1: float32 or float64 as stored, native bytes, C order.

    `width` may be a tuple: (22, 3) reads joints [T, 22, 3]. `name` stands for the file in errors (default:
    its path). `limit` is the largest absolute value allowed, one number or one per column ([width]). Raises
    `UserError` for everything listed in the module's docstring, naming frame and column of a bad value.
    """
    label = str(path) if name is None else name
    check_array_header(path, width=width, name=label)
    found = np.load(path, allow_pickle=False)
    values = np.ascontiguousarray(found, dtype=found.dtype.newbyteorder("="))
    check_values(values, limit, label)
    return values


def check_array_header(path: Path, *, width: int | tuple[int, ...], name: str | None = None) -> int:
    """T of a file that `load_array` accepts as far as header and size tell; `UserError` otherwise."""
    label = str(path) if name is None else name

    def read() -> int:
        header = npy_header(path, label, MAX_BYTES)
        _check_header(header, width, label)
        return header.shape[0]

    return recall(f"frames of {width}", path, read)


def _check_header(header: ArrayHeader, width: int | tuple[int, ...], label: str) -> None:
    shape = header.shape
    dtype = header.dtype
    columns = (width,) if isinstance(width, int) else width
    if len(shape) > 1 and shape[0] == 0:
        raise UserError(f"{label}: zero length, no frames")
    if shape[1:] == columns and len(shape) == len(columns) + 1:
        if dtype.kind != "f" or dtype.itemsize not in (4, 8):
            raise UserError(f"{label}: values are {dtype.name}; expected float32 or float64")
        return
    hint = ""
    if shape == columns:
        hint = "; one frame without the time axis"
    elif len(shape) == len(columns) + 2 and shape[2:] == columns:
        hint = "; a stray batch axis"
    elif len(shape) == 2 and shape[:1] == columns:
        hint = "; it seems to be transposed"
    wanted = ", ".join(str(count) for count in columns)
    raise UserError(f"{label}: expected [T, {wanted}], found {list(shape)}{hint}")


def check_values(
    values: NDArray[np.floating], limit: Limit | None, label: str, *, first_frame: int = 0
) -> None:
    """`UserError` for the first value (in time order) of [T, ...] that is not finite or beyond the limit."""
    wrong = ~np.isfinite(values)
    if wrong.any():
        at = np.argwhere(wrong)[0]
        raise UserError(f"{label}: {values[tuple(at)]} at {_place(at, first_frame)}")
    if limit is None:
        return
    # Compared in pieces of the array's own type: no float64 copy of a float32 array.
    over = np.abs(values) > np.broadcast_to(np.asarray(limit, dtype=values.dtype), values.shape)
    if over.any():
        at = np.argwhere(over)[0]
        most = float(np.broadcast_to(limit, values.shape)[tuple(at)])
        found = f"absurd value {values[tuple(at)]:.4g} at {_place(at, first_frame)}"
        raise UserError(f"{label}: {found}; at most {most:g} is sensible")


def _place(at: NDArray[np.int64], first_frame: int) -> str:
    frame, *rest = (int(index) for index in at)
    return f"frame {first_frame + frame}, column {', '.join(str(index) for index in rest)}"
