"""The expression basis of a head that the user has a licence for: errors of its vertices can be measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError

EXPRESSIONS = 50


def read_basis(path: Path) -> NDArray[np.float64]:
    """Floats [V, 3, 50] in metres: how far each vertex moves with each value of the expression."""
    try:
        found = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: cannot be read as an expression basis, .npy [V, 3, 50] ({error})") from None
    shape = list(found.shape) if isinstance(found, np.ndarray) else "an archive of arrays"
    if not isinstance(found, np.ndarray) or found.ndim != 3 or found.shape[1:] != (3, EXPRESSIONS):
        raise UserError(
            f"{path}: an expression basis has the shape [V, 3, {EXPRESSIONS}], and this is {shape}"
        )
    if not np.issubdtype(found.dtype, np.floating) or not np.isfinite(found).all():
        raise UserError(f"{path}: an expression basis holds finite floats in metres")
    return np.asarray(found, dtype=np.float64)
