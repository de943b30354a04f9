"""An idle pose: what the figure does in silence, where no words say what to do [ours].

No network knows how to do nothing. So the frames of such a stretch are those of a person who stands with
lowered arms, in the layout's own columns; what is before and after it is blended in.
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
"""Seconds from moving to the idle pose, and back."""
_TURNS = {
    "neck": (0, 0.06),
    "left_shoulder": (2, -1.25),
    "right_shoulder": (2, 1.25),
    "left_elbow": (1, -0.25),
    "right_elbow": (1, 0.25),
}
"""Axis and radians by which joints of the rest pose are turned: lowered arms, bent a little."""


def blend_to_idle(
    motion: NDArray[np.float32], idle: Sequence[bool], frames: Sequence[int], layout: MotionLayout, part: Part
) -> NDArray[np.float32]:
    """A motion [T, C] of a part in its own units, idle in those of its stretches, so many frames each, that
    `idle` says.

    Idle frames at the very start are so from the first one on; frames that are neither idle nor near an idle
    stretch are returned as they are.
    """
    if not any(idle):
        return motion
    columns = layout.part(part)
    out = []
    pose, posed, held = (values[columns] for values in _standing(layout))
    level = float(idle[0])
    place: NDArray[np.float32] | None = None
    for piece, calm in zip(np.split(motion, np.cumsum(frames)[:-1]), idle, strict=True):
        change = np.arange(1, len(piece) + 1) / (EASE * layout.fps)
        # Share of the idle pose in each frame, 0 to 1.
        levels = np.clip(level + (change if calm else -change), 0.0, 1.0)
        level = float(levels[-1])
        if not levels.any():
            place = None
            out.append(piece)
            continue
        if place is None:
            # The figure must not wander off or turn while it is idle.
            place = piece[0, held]
        # A smooth step leaves and arrives at speed 0, so that neither end of the blend jerks.
        weight = (levels * levels * (3 - 2 * levels))[:, None]
        goal = piece.copy()
        goal[:, posed] = pose[posed]
        goal[:, held] = place
        out.append(np.asarray(piece + weight * (goal - piece), dtype=np.float32))
    return np.concatenate(out)


def _standing(layout: MotionLayout) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """A frame [D] of somebody who stands; which columns [D] it poses, and which are held as they were where a
    stretch begins.

    Of SMPL parameters, place and turn of the figure are held, and shape and face go on.
    """
    from scipy.spatial.transform import Rotation

    skeleton = layout.skeleton
    turns = np.zeros((len(skeleton), 3))
    for name, (axis, angle) in _TURNS.items():
        turns[skeleton.index(name), axis] = angle
    if len(skeleton) > BODY_JOINTS:
        fingers = Rotation.from_matrix(relaxed_fingers()).as_rotvec()
        turns[BODY_JOINTS:] = np.concatenate([fingers, fingers * [1.0, -1.0, -1.0]])
    if layout.family != "raw":
        local = Rotation.from_rotvec(turns).as_matrix()[None]
        joints, _ = forward_kinematics(local, np.zeros(3), skeleton.offsets, skeleton.parents)
        joints[..., 1] -= joints[..., 1].min()
        # Features of a frame look at its neighbours, which are equal.
        frame = encode(np.repeat(joints, 3, axis=0), layout)[1]
        return frame, np.ones(layout.dim, dtype=bool), np.zeros(layout.dim, dtype=bool)
    out = np.zeros(layout.dim, dtype=np.float32)
    posed, held = np.zeros((2, layout.dim), dtype=bool)
    pose = turns[1:].ravel()
    body = 3 * (BODY_JOINTS - 1)
    held[layout.slice("trans")] = True
    if layout.has("pose"):
        first = layout.slice("pose").start
        held[first : first + 3] = True
        fields = [(slice(first + 3, first + 3 + len(pose)), pose)]
    else:
        held[layout.slice("root_orient")] = True
        fields = [(layout.slice("pose_body"), pose[:body]), (layout.slice("pose_hand"), pose[body:])]
    for columns, values in fields:
        out[columns] = values
        posed[columns] = True
    return out, posed, held
