"""Hands at rest for a figure that was recorded without fingers [ours].

Each hand goes with its forearm as if wrist and fingers were relaxed: the rest pose's hand, its fingers bent a
little, turned by the smallest rotations that take the rest pose's arm onto the recorded one, and as large as
the forearm is long. Positions alone do not show how a forearm is twisted, so neither do these hands.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations
from motionloom.datasets.motion.skeleton import Skeleton

RELAXED_FLEX = ((0.3, 0.4, 0.25), (0.38, 0.45, 0.3), (0.5, 0.5, 0.3), (0.45, 0.48, 0.3))
"""Flexion of (knuckle, middle joint, last joint) for index, middle, pinky, ring; radians."""
RELAXED_FAN = (-0.06, -0.02, 0.1, 0.04)
"""Spreading of the same fingers about Y; radians."""
RELAXED_THUMB = ((0.25, 0.1, -0.25), (0.0, 0.1, -0.15), (0.0, 0.1, -0.1))
"""Rotation vectors of the three thumb joints of the left hand."""

_WHOLE, _BODY = Skeleton.named("smplx52"), Skeleton.named("smpl22")
_FINGERS = 15
_MIRROR = np.outer([-1.0, 1.0, 1.0], [-1.0, 1.0, 1.0])


def relaxed_fingers() -> NDArray[np.float64]:
    """Local rotations [15, 3, 3] of a relaxed left hand, in the order of `smplx52`."""
    from scipy.spatial.transform import Rotation

    out = np.empty((_FINGERS, 3, 3))
    for finger, (bends, fan) in enumerate(zip(RELAXED_FLEX, RELAXED_FAN, strict=True)):
        turns = Rotation.from_euler("z", -np.asarray(bends)[:, None]).as_matrix()
        turns[0] = Rotation.from_euler("y", fan).as_matrix() @ turns[0]
        out[3 * finger : 3 * finger + 3] = turns
    out[12:] = Rotation.from_rotvec(RELAXED_THUMB).as_matrix()
    return out


def relaxed_hands() -> NDArray[np.float64]:
    """Local rotations [30, 3, 3] of both hands, as they follow the body in `smplx52`."""
    return np.concatenate([relaxed_fingers(), relaxed_fingers() * _MIRROR])


def with_resting_hands(
    joints: NDArray[np.floating], fingers: Sequence[NDArray[np.floating]] | None = None
) -> NDArray[np.float64]:
    """Joints [T, 22, 3] of `smpl22` in metres -> [T, 52, 3] of `smplx52`; the body stays as it is.

    `fingers` are the left and the right hand's local rotations [T, 15, 3, 3], each as of a left hand; None:
    both are relaxed.
    """
    if joints.ndim != 3 or joints.shape[1:] != (len(_BODY), 3):
        raise UserError(f"hands are added to joints [T, {len(_BODY)}, 3], not to {list(joints.shape)}")
    frames = len(joints)
    body = np.asarray(joints, dtype=np.float64)
    # Global rotations of the body: a wrist, the end of its chain there, is turned as its forearm is.
    _, world = forward_kinematics(joints_to_rotations(body, _BODY), body[:, 0], _BODY.offsets, _BODY.parents)
    out = np.empty((frames, len(_WHOLE), 3))
    out[:, : len(_BODY)] = body
    left, right = (relaxed_fingers(),) * 2 if fingers is None else fingers
    for side, turns, first in (("left", left, 22), ("right", right * _MIRROR, 22 + _FINGERS)):
        wrist = _WHOLE.index(f"{side}_wrist")
        elbow = _WHOLE.index(f"{side}_elbow")
        own = list(range(first, first + _FINGERS))
        place = {wrist: 0} | {joint: number for number, joint in enumerate(own, start=1)}
        parents = [-1, *(place[_WHOLE.parents[joint]] for joint in own)]
        bone = float(np.median(np.linalg.norm(body[:, wrist] - body[:, elbow], axis=-1)))
        size = bone / float(np.linalg.norm(_WHOLE.offsets[wrist]))
        local = np.empty((frames, 1 + _FINGERS, 3, 3))
        local[:, 0] = world[:, wrist]
        local[:, 1:] = turns
        offsets = np.concatenate([np.zeros((1, 3)), _WHOLE.offsets[own] * size])
        out[:, own] = forward_kinematics(local, body[:, wrist], offsets, parents)[0][:, 1:]
    return out
