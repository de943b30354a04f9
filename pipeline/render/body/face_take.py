"""A recorded face as expression columns: a take of ARKit's weights becomes those of a data set, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.motion.body.arkit import ArkitBases
from motionloom.datasets.motion.body.live_link import ANGLES, FaceTake, read_face, write_face
from motionloom.datasets.motion.layout import FACE_DIMS
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.body.face import recorded_expression, synthetic_arkit


def convert_face(source: Path, out: Path, bases: Path | None = None) -> tuple[int, float]:
    """Write expression columns (.npz) of a take (.csv), or a take of columns; returns frames and frame rate.

    The npz holds `expression` [T, K], `angles` [T, 9] of head and eyes in radians, and `fps`. By the bases of
    the package K is 50. `UserError` for other suffixes and for what the files hold wrongly.
    """
    own = None if bases is None else ArkitBases.read(bases)
    if (source.suffix.lower(), out.suffix.lower()) == (".csv", ".npz"):
        take = read_face(source)
        values = recorded_expression(take.weights) if own is None else own.expressions(take.weights)
        with atomic_file(out) as file:
            np.savez(file, expression=values.astype(np.float32), angles=take.angles, fps=take.fps)
        return len(values), take.fps
    if (source.suffix.lower(), out.suffix.lower()) != (".npz", ".csv"):
        raise UserError(f"{source} -> {out}: a take (.csv) becomes columns (.npz), or columns a take")
    with NpzFile(source) as arrays:
        values, angles = arrays.numbers("expression"), arrays.numbers("angles")
        fps = float(arrays.numbers("fps"))
    if values.ndim != 2 or angles.shape != (len(values), len(ANGLES)) or not np.isfinite(values).all():
        raise UserError(
            f"{source}: expression {list(values.shape)} and angles {list(angles.shape)} must be finite, "
            f"[T, K] and [T, {len(ANGLES)}]"
        )
    if own is None and values.shape[1] != FACE_DIMS:
        raise UserError(f"{source}: {values.shape[1]} expression values, not {FACE_DIMS}, need --arkit-bases")
    weights = synthetic_arkit(values) if own is None else own.weights(values)
    write_face(out, FaceTake(weights, angles, fps))
    return len(values), fps
