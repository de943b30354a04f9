"""How large the values of a layout may be in a person's motion.

Two limits a field. Beyond the first, no person does it, but a glitch of one frame may: a warning. Beyond ten
times the first, it is no motion in metres and radians at all: an error (a wrong unit, scale or layout).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import require_finite

ABSURD = 10.0
"""An error is this many times the first limit."""
LARGEST = 1e6
"""No feature of motion or music is larger, whatever it means."""


def require_sensible(what: str, values: NDArray[np.floating]) -> None:
    """`ValueError` naming the first row of [..., E] that holds NaN, infinity or a number beyond `LARGEST`."""
    require_finite(what, values)
    far = (np.abs(values) > LARGEST).any(axis=-1)
    if far.any():
        raise ValueError(f"{what}: absurd value in row {int(far.argmax())}; at most {LARGEST:g} is sensible")


_PER_SECOND = {
    "root_yaw_velocity": 40.0,  # six turns a second, a figure skater's record spin
    "root_xz_velocity": 15.0,  # sprinters reach 12.4
    "velocities": 40.0,  # the fastest hand stays below 30
}
"""Limits of columns that hold a change per frame, given a second."""

_PLAIN = {
    **dict.fromkeys(("root_height", "positions"), 4.0),  # heights are absolute: a jump with raised arms
    **dict.fromkeys(("rotations_6d", "foot_contacts"), 1.001),  # parts of unit vectors; 0 or 1
    **dict.fromkeys(("face", "face_shape", "betas"), 10.0),  # coefficients with a deviation near 1
    "trans": 30.0,  # a capture hall; AIST++ before its scaling is beyond it
    # More than one full turn says nothing new.
    **dict.fromkeys(("pose", "root_orient", "pose_body", "pose_hand", "pose_jaw"), 2 * math.pi),
}


def human_limits(layout: MotionLayout) -> NDArray[np.float64]:
    """Largest absolute value a person reaches, for every column [D]."""
    out = np.empty(layout.dim)
    for field, _ in layout.fields:
        out[layout.slice(field)] = _PER_SECOND[field] / layout.fps if field in _PER_SECOND else _PLAIN[field]
    return out


def beyond(
    motion: NDArray[np.floating], layout: MotionLayout, limits: NDArray[np.float64], factor: float = 1.0
) -> str:
    """What in motion [T, D] is beyond `factor` times the limits [D]: the worst value and its place, or ""."""
    if motion.size == 0:
        return ""
    ratio = np.abs(motion).max(axis=0) / limits
    column = int(ratio.argmax())
    if not ratio[column] > factor:
        return ""
    frame = int(np.abs(motion[:, column]).argmax())
    field = next(name for name, _ in layout.fields if column < layout.slice(name).stop)
    at = column - layout.slice(field).start
    value, most, unit = float(motion[frame, column]), float(limits[column]), ""
    if field in _PER_SECOND:
        unit = " rad/s" if field == "root_yaw_velocity" else " m/s"
        value, most = value * layout.fps, most * layout.fps
    return f"{field}[{at}] is {value:.4g}{unit} at frame {frame}; at most {most:.4g} is sensible"
