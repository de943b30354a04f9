"""Joints to features and back, for both families (HumanTOMATO section 4.2).

`exact` is invertible and keeps the number of frames; `h3d` (h3d.py) equals the published HumanML3D
and HumanTOMATO features, has one frame less than the joints, and retargets to the layout's skeleton first.
The layout says which family an array holds. Both work on whole sequences and any leading dimensions.

`exact` are HumanTOMATO's features without HumanML3D's numerical quirks:

| column | meaning |
|---|---|
| root_yaw_velocity | change of the smoothed heading to the next frame, rad/frame, positive = left |
| root_xz_velocity | (x, z) step of the root to the next frame, m/frame, in the heading frame of this frame |
| root_height | m |
| positions | joints 1..N-1, x and z relative to the root in the heading frame, y absolute, m |
| velocities | steps of joints 0..N-1 to the next frame, m/frame, in the heading frame of this frame |
| face | expression coefficients as given, 0 where a clip has none |

Against `h3d`: the full angle instead of half of it with the opposite sign, no flip at 180 degrees, frame 0
like every other, one heading for root and joint velocities, as many frames out as in (the last frame has no
next one and repeats the velocities of the one before). The features do not depend on where the clip stands or
which way it first faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.canonical import ground, heading
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import FACE_DIMS, MotionLayout

_GROUP_FRAMES = 800
"""Clips are encoded in groups of about so many frames. Measured: larger groups leave the cache and run at
half the speed, single clips of 200 frames pay as much for calls as for arithmetic."""


def encode(
    joints: NDArray[np.floating], layout: MotionLayout, face: NDArray[np.floating] | None = None
) -> NDArray[np.float32]:
    """Canonical joints [..., T, N, 3] in metres -> features [..., T', D]: T' = T (exact) or T - 1 (h3d).

    `face` [..., T, 50] fills the layout's face columns; without it they are 0. Joints are not moved: call
    `canonicalize` first (h3d does its own).
    """
    _check_family(layout)
    _check_joints(joints, layout)
    kernel = encode_h3d if layout.family == "h3d" else encode_exact
    frames = joints.shape[-3] - (layout.family == "h3d")
    clips = joints.reshape(-1, *joints.shape[-3:])
    group = max(1, _GROUP_FRAMES // joints.shape[-3])
    out = np.empty((len(clips), frames, layout.dim), dtype=np.float32)
    for start in range(0, len(clips), group):
        out[start : start + group] = kernel(clips[start : start + group], layout)
    out = out.reshape(*joints.shape[:-3], frames, layout.dim)
    if face is not None:
        if not layout.has("face"):
            raise UserError(f"layout {layout.name} has no face columns; wholebody363 has")
        if face.shape != (*joints.shape[:-2], FACE_DIMS):
            raise UserError(f"face of shape {list(face.shape)} does not fit joints {list(joints.shape)}")
        out[..., layout.slice("face")] = face[..., :frames, :]
    return out


def decode(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64]:
    """Features [..., T, D] -> joints [..., T, N, 3], float64, metres; frame 0 faces +Z at the origin."""
    _check_family(layout)
    if features.ndim < 2 or features.shape[-1] != layout.dim:
        raise UserError(
            f"layout {layout.name} has {layout.dim} columns, but these features are {list(features.shape)}"
        )
    if not features.shape[-2]:
        return np.zeros((*features.shape[:-1], layout.num_joints, 3))
    yaw = np.asarray(features[..., layout.slice("root_yaw_velocity")][..., 0], dtype=np.float64)
    published = layout.family == "h3d"
    turn = np.exp((-2j if published else 1j) * np.cumsum(_delayed(yaw), axis=-1))
    xz = np.asarray(features[..., layout.slice("root_xz_velocity")], dtype=np.float64)
    own = xz[..., 1] + 1j * xz[..., 0]
    # A published step is seen from the heading of the frame that it leads to.
    steps = _delayed(own) * turn if published else _delayed(own * turn)
    return place(features, layout, turn, np.cumsum(steps, axis=-1))


def _delayed(steps: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """The step [..., T] that leads to each frame, of those that follow each; 0 before the first."""
    return np.concatenate([np.zeros_like(steps[..., :1]), steps[..., :-1]], axis=-1)


def face_of(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.floating]:
    """The expression columns [..., T, 50] of features [..., T, D]."""
    return features[..., layout.slice("face")]


def _check_family(layout: MotionLayout) -> None:
    if layout.family == "raw" or not layout.has("root_yaw_velocity"):
        raise UserError(
            f"layout {layout.name} (family '{layout.family}') is raw parameters; convert it to joints first"
        )
    if layout.family == "exact" and layout.has("rotations_6d"):
        raise UserError(f"layout {layout.name} holds rotations and contacts, which only the h3d family has")


def _check_joints(joints: NDArray[np.floating], layout: MotionLayout) -> None:
    wanted = (layout.num_joints, 3)
    least = 2 if layout.family == "h3d" else 1
    if joints.ndim < 3 or joints.shape[-2:] != wanted:
        raise UserError(
            f"layout {layout.name} needs joints [..., T, {wanted[0]}, 3], but these are {list(joints.shape)}"
        )
    if joints.shape[-3] < least:
        raise UserError(
            f"a clip of {joints.shape[-3]} frames is too short: the {layout.family} family needs {least}"
        )
    if not np.isfinite(joints).all():
        raise UserError("joints hold NaN or infinite values")


def encode_exact(
    joints: NDArray[np.floating], layout: MotionLayout, angle: NDArray[np.float64] | None = None
) -> NDArray[np.float32]:
    """Joints [..., T, N, 3] in metres -> features [..., T, D]; a `face` field is left at 0.

    `angle` [..., T] are headings in radians, where others than the joints' own smoothed ones are wanted.
    """
    *lead, frames, _, _ = joints.shape
    out = np.zeros((*lead, frames, layout.dim), dtype=np.float32)
    angle = heading(joints, layout.fps) if angle is None else angle
    unturn = np.exp(-1j * angle)[..., None]
    plane = ground(joints)

    out[..., layout.slice("root_height")] = joints[..., 0, 1:2]
    local = (plane[..., 1:] - plane[..., :1]) * unturn
    _put(out[..., layout.slice("positions")], local, joints[..., 1:, 1])
    if frames > 1:
        step = np.diff(plane, axis=-2) * unturn[..., :-1, :]
        rise = np.diff(joints[..., 1], axis=-2)
        _put(out[..., :-1, layout.slice("velocities")], step, rise)
        out[..., :-1, layout.slice("root_yaw_velocity")] = np.diff(angle, axis=-1)[..., None]
        root = out[..., :-1, layout.slice("root_xz_velocity")]
        root[..., 0] = step[..., 0].imag
        root[..., 1] = step[..., 0].real
        for field in ("velocities", "root_yaw_velocity", "root_xz_velocity"):
            out[..., -1, layout.slice(field)] = out[..., -2, layout.slice(field)]
    return out


def place(
    features: NDArray[np.floating], layout: MotionLayout, turn: NDArray[np.inexact], root: NDArray[np.inexact]
) -> NDArray[np.float64]:
    """Local positions in the world: `turn` = exp(i heading), `root` = z + i x, both [..., T], metres."""
    *lead, frames, _ = features.shape
    joints = np.empty((*lead, frames, layout.num_joints, 3), dtype=np.float64)
    local = features[..., layout.slice("positions")].reshape(*lead, frames, layout.num_joints - 1, 3)
    plane = ground(local) * turn[..., None] + root[..., None]
    joints[..., 0, 0] = root.imag
    joints[..., 0, 2] = root.real
    joints[..., 0, 1] = features[..., layout.slice("root_height")][..., 0]
    joints[..., 1:, 0] = plane.imag
    joints[..., 1:, 2] = plane.real
    joints[..., 1:, 1] = local[..., 1]
    return joints


def _put(columns: NDArray[np.float32], plane: NDArray[np.complex128], height: NDArray[np.floating]) -> None:
    """Write points given as z + i x and y into columns x0 y0 z0 x1 ... of a feature array."""
    points = columns.reshape(*columns.shape[:-1], -1, 3)
    points[..., 0] = plane.imag
    points[..., 1] = height
    points[..., 2] = plane.real
