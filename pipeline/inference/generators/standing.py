"""A calm stand: what the figure does while nothing is heard, and no words say what to do [ours].

No network knows how to do nothing. So the frames of such a stretch are those of a person who stands with
lowered arms and breathes, in the layout's own columns; what is before and after it is blended in.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.resting_hands import relaxed_fingers
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout, Part

EASE = 1.0
"""Seconds from moving to standing, and back."""
BREATH = 4.0
"""Seconds of a breath."""
_ARMS = 1.25
"""Radians by which the rest pose's arms are lowered."""


class Standing:
    """Puts the stand into a motion that comes piece by piece.

    Args:
        layout: Layout of whole frames.
        part: The columns of it that the pieces have.
    """

    def __init__(self, layout: MotionLayout, part: Part) -> None:
        self._fps, columns = layout.fps, layout.part(part)
        self._breath, stands, stays = (values[..., columns] for values in _breath(layout))
        self._stands, self._stays = np.flatnonzero(stands), np.flatnonzero(stays)
        self._level: float | None = None
        """How far it stands, 0..1, before the next frame."""
        self._number = 0
        self._place: NDArray[np.float32] | None = None
        """The columns that stay, as they were when the stand began."""

    def __call__(self, motion: NDArray[np.float32], stand: bool) -> NDArray[np.float32]:
        """The next frames [T, C] in their own units, which stand (from the first frame on, if they are the
        first) or do not; what does not and is not near a stand is returned as it is.
        """
        level = float(stand) if self._level is None else self._level
        change = np.arange(1, len(motion) + 1) / (EASE * self._fps)
        levels = np.clip(level + (change if stand else -change), 0.0, 1.0)
        if len(motion):
            self._level = float(levels[-1])
        if not levels.any():
            self._place = None
            return motion
        if self._place is None:
            self._place = motion[0, self._stays].copy()
        weight = (levels * levels * (3 - 2 * levels))[:, None]
        goal = motion.copy()
        goal[:, self._stands] = self._breath[(self._number + np.arange(len(motion))) % len(self._breath)][
            :, self._stands
        ]
        goal[:, self._stays] = self._place
        self._number += len(motion)
        return np.asarray(motion + weight * (goal - motion), dtype=np.float32)


def stood(
    motion: NDArray[np.float32],
    stands: Sequence[bool],
    frames: Sequence[int],
    layout: MotionLayout,
    part: Part,
) -> NDArray[np.float32]:
    """A motion [T, C] of a part that stands where its stretches, so many frames each, say so."""
    if not any(stands):
        return motion
    standing = Standing(layout, part)
    pieces = np.split(motion, np.cumsum(frames)[:-1])
    return np.concatenate([standing(piece, calm) for piece, calm in zip(pieces, stands, strict=True)])


def _breath(layout: MotionLayout) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """A breath [T, D]; which columns [D] it gives, and which stay as they were where a stand begins."""
    frames, skeleton = round(BREATH * layout.fps), layout.skeleton
    turns = _turns(layout, np.sin(2 * np.pi * np.arange(2 * frames + 1) / frames))
    gives, stays = np.ones(layout.dim, dtype=bool), np.zeros(layout.dim, dtype=bool)
    if layout.family == "raw":
        return _raw_breath(layout, turns[:frames])
    local = np.array([_matrices(frame) for frame in turns])
    joints, _ = forward_kinematics(local, np.zeros(3), skeleton.offsets, skeleton.parents)
    joints[..., 1] -= joints[..., 1].min()
    return encode(joints, layout)[frames - 1 : 2 * frames - 1], gives, stays


def _raw_breath(
    layout: MotionLayout, turns: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """SMPL parameters say where the figure is and how it is turned: that stays; shape and face go on."""
    out = np.zeros((len(turns), layout.dim), dtype=np.float32)
    gives, stays = np.zeros((2, layout.dim), dtype=bool)
    pose = turns[:, 1:].reshape(len(turns), -1)
    stays[layout.slice("trans")] = True
    if layout.has("pose"):
        first = layout.slice("pose").start
        stays[first : first + 3] = True
        fields = [(slice(first + 3, first + 3 + pose.shape[1]), pose)]
    else:
        stays[layout.slice("root_orient")] = True
        body = 3 * (BODY_JOINTS - 1)
        fields = [(layout.slice("pose_body"), pose[:, :body]), (layout.slice("pose_hand"), pose[:, body:])]
    for columns, values in fields:
        out[:, columns], gives[columns] = values, True
    return out, gives, stays


def _turns(layout: MotionLayout, air: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vectors [T, N, 3] of somebody who stands; `air` [T] goes from -1, breathed out, to 1."""
    from scipy.spatial.transform import Rotation

    skeleton = layout.skeleton
    out = np.zeros((len(air), len(skeleton), 3))
    for name, axis, still, breath in (
        ("spine2", 0, 0.0, -0.012),
        ("spine3", 0, 0.0, -0.012),
        ("neck", 0, 0.06, 0.015),
        ("left_collar", 2, 0.0, 0.02),
        ("right_collar", 2, 0.0, -0.02),
        ("left_shoulder", 2, -_ARMS, -0.02),
        ("right_shoulder", 2, _ARMS, 0.02),
        ("left_elbow", 1, -0.25, 0.0),
        ("right_elbow", 1, 0.25, 0.0),
    ):
        out[:, skeleton.index(name), axis] = still + breath * air
    if len(skeleton) > BODY_JOINTS:
        fingers = Rotation.from_matrix(relaxed_fingers()).as_rotvec()
        out[:, BODY_JOINTS : BODY_JOINTS + len(fingers)] = fingers
        out[:, BODY_JOINTS + len(fingers) :] = fingers * [1.0, -1.0, -1.0]
    return out


def _matrices(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(turns).as_matrix())
