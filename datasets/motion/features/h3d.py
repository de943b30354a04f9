"""The `h3d` feature family: equal to the published HumanML3D and HumanTOMATO features, quirks included.

Needed for `new_joint_vecs` and for evaluators trained on them. The quirks, all reproduced on purpose:

1. The facing direction has the hips the wrong way round: left minus right hip plus right minus left shoulder.
   (The clip is first turned to +Z by the right formula.)
2. The heading is smoothed over 20 frames at any frame rate, as vectors that weigh a leaning figure less.
3. Frame 0 is forced to heading 0: the first yaw velocity holds the offset from raw to smoothed heading.
4. The yaw velocity is half the angle, positive to the right; its sign flips where the heading passes +-180.
5. The root velocity is seen from the heading of the next frame, joint velocities from this one's.
6. Rotations are relative to the previous joint of the published chains, whose first joints (hips, spine,
   collars, first finger joints) are relative to the *inverse* root heading; their rest directions are axes,
   not the skeleton's.
7. Foot contact is a squared step below 0.002 m^2, at any height.

Not reproduced: NaN for bones without length or opposite to their rest direction, and the wrong axis that the
published code takes for clips of exactly 3 frames.

Arrays are joint-first inside ([3, N, ..., T]): a parent lookup is a row, and time is contiguous.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import (
    LEFT_HIP,
    LEFT_SHOULDER,
    RIGHT_HIP,
    RIGHT_SHOULDER,
    canonicalize,
    ground,
    retarget,
)
from motionloom.datasets.motion.kinematics import multiply, swing
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton

SMOOTH_FRAMES = 20
CONTACT_STEP = 0.002
"""Square metres per frame."""

_FEET = ("left_ankle", "left_foot", "right_ankle", "right_foot")
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_SIDEWAYS = ("hip", "collar", *_FINGERS)
_UPWARD = ("spine1", "spine2", "spine3", "neck")
_FORWARD = ("foot", "head")
_CHAIN_STARTS = ("hip", "spine1", "collar", *(f"{finger}1" for finger in _FINGERS))


def encode_h3d(
    joints: NDArray[np.floating], layout: MotionLayout, offsets: NDArray[np.floating] | None = None
) -> NDArray[np.float32]:
    """Joints [..., T, N, 3] (metres, Y up) -> features [..., T - 1, D]; a `face` field is left at 0.

    The clip is retargeted to `offsets` [N, 3] (metres, default the skeleton's own; only their lengths count)
    and made canonical first. `body133` and `wholebody313` are the slices of the 263 and 623 columns without
    rotations and contacts.
    """
    world = uniform_joints(joints, layout.skeleton, offsets)
    angle = _published_heading(world)
    unturn = np.exp(-1j * angle)
    # Axes first: every step below is then one run over contiguous frames.
    points = np.ascontiguousarray(np.moveaxis(world, (-1, -2), (0, 1)))
    plane = points[2] + 1j * points[0]
    step = np.diff(plane, axis=-1)
    rise = np.diff(points[1], axis=-1)

    lead = world.shape[:-3]
    frames = world.shape[-3] - 1
    rows = np.zeros((layout.dim, *lead, frames), dtype=np.float32)
    rows[layout.slice("root_yaw_velocity")] = np.arcsin(np.sin(-0.5 * np.diff(angle, axis=-1)))
    # The published code turns the root's step by the heading of the frame that it leads to, and all other
    # steps by that of the frame that they start from.
    root = rows[layout.slice("root_xz_velocity")]
    seen = step[0] * unturn[..., 1:]
    root[0] = seen.imag
    root[1] = seen.real
    rows[layout.slice("root_height")] = points[1, :1, ..., :-1]

    local = (plane[1:, ..., :-1] - plane[:1, ..., :-1]) * unturn[..., :-1]
    _put(rows[layout.slice("positions")], local, points[1, 1:, ..., :-1])
    _put(rows[layout.slice("velocities")], step * unturn[..., :-1], rise)
    if layout.has("rotations_6d"):
        sixd = rotations_6d(points[..., :-1], angle[..., :-1], layout.skeleton)
        rows[layout.slice("rotations_6d")] = sixd.reshape(-1, *lead, frames)
    if layout.has("foot_contacts"):
        feet = [layout.skeleton.index(name) for name in _FEET]
        square = step[feet].real ** 2 + step[feet].imag ** 2 + rise[feet] ** 2
        rows[layout.slice("foot_contacts")] = square < CONTACT_STEP
    return np.ascontiguousarray(np.moveaxis(rows, 0, -1))


def uniform_joints(
    joints: NDArray[np.floating], skeleton: Skeleton, offsets: NDArray[np.floating] | None = None
) -> NDArray[np.float64]:
    """The joints behind the features: retargeted, on the floor, above the origin, first frame facing +Z."""
    return np.asarray(canonicalize(retarget(joints, skeleton, offsets)), dtype=np.float64)


def _published_heading(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heading [..., T] in (-pi, pi] with quirks 1 to 3; the published root quaternion is its inverse."""
    from scipy.ndimage import gaussian_filter1d

    across = joints[..., LEFT_HIP, :] - joints[..., RIGHT_HIP, :]
    across = across + joints[..., RIGHT_SHOULDER, :] - joints[..., LEFT_SHOULDER, :]
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    forward = 1j * ground(across)
    smooth = gaussian_filter1d(forward, SMOOTH_FRAMES, axis=-1, mode="nearest")
    angle = np.angle(smooth)
    angle[..., 0] = 0.0
    return np.asarray(angle, dtype=np.float64)


def rotations_6d(
    points: NDArray[np.float64], angle: NDArray[np.float64], skeleton: Skeleton
) -> NDArray[np.float64]:
    """Points [3, N, ..., T], heading [..., T] -> two rotation columns of joints 1.. [N - 1, 2, 3, ..., T]."""
    parents = np.asarray(skeleton.parents[1:])
    directions, starts = published_chains(skeleton)
    axes = directions.T.reshape(3, -1, *(1,) * angle.ndim)
    bones = points[:, 1:] - points[:, parents]
    length = np.sqrt(bones[0] ** 2 + bones[1] ** 2 + bones[2] ** 2)
    if not length.all():  # a bone without length has no direction: as at rest
        bones = np.where(length > 0, bones, axes)
        length = np.where(length > 0, length, 1.0)
    bones /= length
    world = swing(axes, bones)

    # Published chains each start from the root's heading, whatever the parent's rotation is (quirk 6).
    above = np.empty_like(world)
    above[:, :, starts] = _about_y(-angle)[:, :, None]
    above[:, :, ~starts] = world[:, :, parents[~starts] - 1]
    local = multiply(above.swapaxes(0, 1), world[:, :2])
    return np.moveaxis(local, 2, 0).swapaxes(1, 2)


@cache
def published_chains(skeleton: Skeleton) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rest directions [N - 1, 3] of joints 1..N-1, all along axes, and which ones [N - 1] start a chain."""
    axes = np.zeros((len(skeleton) - 1, 3))
    for axis, name in zip(axes, skeleton.joints[1:], strict=True):
        if any(word in name for word in _SIDEWAYS):
            axis[0] = 1.0 if name.startswith("left") else -1.0
        elif any(word in name for word in _FORWARD):
            axis[2] = 1.0
        else:
            axis[1] = 1.0 if name in _UPWARD else -1.0
    starts = np.array([any(word in name for word in _CHAIN_STARTS) for name in skeleton.joints[1:]])
    return axes, starts


def _about_y(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations [3, 3, ...] about the Y axis by angles [...]."""
    out = np.zeros((3, 3, *angle.shape))
    out[0, 0] = out[2, 2] = np.cos(angle)
    out[0, 2] = np.sin(angle)
    out[2, 0] = -out[0, 2]
    out[1, 1] = 1.0
    return out


def _put(rows: NDArray[np.float32], plane: NDArray[np.complex128], height: NDArray[np.float64]) -> None:
    """Write points given as z + i x and y, [J, ..., T], into rows x0 y0 z0 x1 ... of a [D, ..., T] array."""
    rows[0::3] = plane.imag
    rows[1::3] = height
    rows[2::3] = plane.real
