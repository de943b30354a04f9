"""Motion-X's 322 columns a frame: the repairs that its own scripts leave to the user, as pure functions.

Arrays are [T, 322] float64: axis-angles in radians, translations in metres (but see `scale_aist`), 30 fps.
Columns are named by the layout `smplx322`. None of the functions changes its argument.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.canonical import resample, resample_quaternions
from motionloom.datasets.motion.layout import FACE_DIMS, MotionLayout

RAW = MotionLayout.named("smplx322")
FACE_WIDTH = 153
"""Columns of a face motion file: jaw 3, expression 50, face shape 100."""

HANDS, JAW = RAW.slice("pose_hand"), RAW.slice("pose_jaw")
EXPRESSION, FACE_SHAPE = RAW.slice("face"), RAW.slice("face_shape")
TRANS, BETAS = RAW.slice("trans"), RAW.slice("betas")

AIST_UNIT = 94.0
"""Units of the `aist/` subset's translations in a metre."""
_AIST_RAW, _AIST_TWICE = 30.0, 0.2
"""Largest |translation| of a clip: raw ones stand about 120 units high, scaled ones stay within a hall of a
few metres, and scaled twice a dance is a few centimetres."""


def value_limits() -> NDArray[np.float64]:
    """Largest sensible absolute value of each column; beyond it a file is damaged."""
    limits = np.full(RAW.dim, 100.0)
    limits[EXPRESSION] = limits[FACE_SHAPE] = 1000.0
    limits[TRANS] = 10_000.0
    return limits


def scale_aist(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """An `aist/` clip in metres: raw translations divided by 94, z negated; scaled ones as they are.

    `UserError` for a clip that was scaled twice: its movement through the room cannot be restored, since the
    second time may have been anything.
    """
    most = float(np.abs(values[:, TRANS]).max())
    if most < _AIST_TWICE:
        raise UserError(
            "the translation stays within 20 cm: the aist script was run twice on it; unpack the clip again"
        )
    if most <= _AIST_RAW:
        return values
    scaled = values.copy()
    scaled[:, TRANS] *= np.array([1.0, 1.0, -1.0]) / AIST_UNIT
    return scaled


def with_face(
    values: NDArray[np.float64], face: NDArray[np.floating], *, keep_jaw: bool
) -> NDArray[np.float64]:
    """Jaw, expression and face shape from a face file [T', 153], stretched to the clip's T frames."""
    stretched = stretch(face, len(values))
    out = values.copy()
    if not keep_jaw:
        out[:, JAW] = stretched[:, :3]
    out[:, EXPRESSION] = stretched[:, 3 : 3 + FACE_DIMS]
    out[:, FACE_SHAPE] = stretched[:, 3 + FACE_DIMS :]
    return out


def stretch(values: NDArray[np.floating], frames: int) -> NDArray[np.float64]:
    """[T', D] -> [frames, D], linear over the whole length.

    Frames are intervals, not instants (the centres of the first intervals need not meet): what Motion-X's
    script does with torch's `interpolate`.
    """
    if len(values) == frames:
        return values.astype(np.float64)
    at = np.clip((np.arange(frames) + 0.5) * (len(values) / frames) - 0.5, 0.0, len(values) - 1.0)
    left = np.floor(at).astype(np.int64)
    right = np.minimum(left + 1, len(values) - 1)
    weight = (at - left)[:, None]
    return np.asarray((1.0 - weight) * values[left] + weight * values[right], dtype=np.float64)


def resample_parameters(values: NDArray[np.float64], fps_in: float, fps_out: float) -> NDArray[np.float64]:
    """[T, 322] at another rate: rotations along the shorter arc, everything else linearly."""
    import roma
    import torch

    if fps_in == fps_out:
        return values
    out = resample(values, fps_in, fps_out)
    turned = JAW.stop  # every column before the expression is an axis-angle
    vectors = torch.from_numpy(np.ascontiguousarray(values[:, :turned]).reshape(len(values), -1, 3))
    quaternions = resample_quaternions(roma.rotvec_to_unitquat(vectors).numpy(), fps_in, fps_out)
    back = roma.unitquat_to_rotvec(torch.from_numpy(quaternions))
    out[:, :turned] = back.reshape(len(out), turned).numpy()
    return out
