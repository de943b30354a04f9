"""The `exact` feature family: HumanTOMATO's features (section 4.2) without HumanML3D's numerical quirks.

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

from motionloom.datasets.motion.canonical import ground, heading
from motionloom.datasets.motion.layout import MotionLayout


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
        root[..., 0], root[..., 1] = step[..., 0].imag, step[..., 0].real
        for field in ("velocities", "root_yaw_velocity", "root_xz_velocity"):
            out[..., -1, layout.slice(field)] = out[..., -2, layout.slice(field)]
    return out


def place(
    features: NDArray[np.floating], layout: MotionLayout, turn: NDArray[np.inexact], root: NDArray[np.inexact]
) -> NDArray[np.float64]:
    """Local positions put into the world: `turn` = exp(i heading) [..., T], `root` = z + i x [..., T],
    metres.
    """
    *lead, frames, _ = features.shape
    joints = np.empty((*lead, frames, layout.num_joints, 3), dtype=np.float64)
    local = features[..., layout.slice("positions")].reshape(*lead, frames, layout.num_joints - 1, 3)
    plane = ground(local) * turn[..., None] + root[..., None]
    joints[..., 0, 0], joints[..., 0, 2] = root.imag, root.real
    joints[..., 0, 1] = features[..., layout.slice("root_height")][..., 0]
    joints[..., 1:, 0], joints[..., 1:, 2] = plane.imag, plane.real
    joints[..., 1:, 1] = local[..., 1]
    return joints


def _put(columns: NDArray[np.float32], plane: NDArray[np.complex128], height: NDArray[np.floating]) -> None:
    """Write points given as z + i x and y into columns x0 y0 z0 x1 ... of a feature array."""
    points = columns.reshape(*columns.shape[:-1], -1, 3)
    points[..., 0], points[..., 1], points[..., 2] = plane.imag, height, plane.real
