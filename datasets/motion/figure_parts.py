"""Parts of a figure and the columns that they are: what an edit keeps or makes anew.

A figure is cut into seven `PIECES` that share no column; every part is some of them. Where the figure goes
and how high its root is belongs to the legs: whoever keeps them keeps the path.

Columns that hold a step to the next frame are known only where both frames are, and those of joints only
where the root is known too, since a joint's step is the world's, not the figure's.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout

FigurePart = Literal[
    "all", "upper", "lower", "left_arm", "right_arm", "left_hand", "right_hand", "hands", "face"
]
"""`lower` are pelvis and legs, and with them where the figure goes; `upper` is all above the pelvis but the
face; arms are without fingers; hands are the fingers."""

PIECES = ("lower", "trunk", "left_arm", "right_arm", "left_hand", "right_hand", "face")
LOWER = PIECES.index("lower")

_ARM, _LEG = ("shoulder", "elbow", "wrist"), ("pelvis", "hip", "knee", "ankle", "foot")
_UPPER = PIECES[1:6]
_OF: dict[FigurePart, tuple[str, ...]] = {"all": PIECES, "upper": _UPPER, "hands": PIECES[4:6]}


def pieces_of(parts: Iterable[FigurePart], but: Iterable[FigurePart] = ()) -> NDArray[np.bool_]:
    """Return the `PIECES` of some parts, bool [7], without those of `but`."""
    without = {piece for part in but for piece in _OF.get(part, (part,))}
    pieces = {piece for part in parts for piece in _OF.get(part, (part,))} - without
    return np.array([piece in pieces for piece in PIECES])


@lru_cache(maxsize=8)
def piece_joints(layout: MotionLayout) -> NDArray[np.int64]:
    """Return the number of every joint's piece [N]."""
    pieces = []
    for number, joint in enumerate(layout.skeleton.joints):
        side, _, rest = joint.partition("_")
        own = "lower" if (rest or joint) in _LEG else "trunk"
        if number >= BODY_JOINTS:
            own = f"{side}_hand"
        elif rest in _ARM:
            own = f"{side}_arm"
        pieces.append(PIECES.index(own))
    return np.array(pieces)


@lru_cache(maxsize=8)
def piece_columns(layout: MotionLayout) -> NDArray[np.int64]:
    """Return the number of every column's piece [D], of motion features."""
    joints = piece_joints(layout)
    columns = np.full(layout.dim, LOWER)
    for field, width, first in (("positions", 3, 1), ("rotations_6d", 6, 1), ("velocities", 3, 0)):
        if layout.has(field):
            columns[layout.slice(field)] = np.repeat(joints[first:], width)
    if layout.has("face"):
        columns[layout.slice("face")] = PIECES.index("face")
    return columns


@lru_cache(maxsize=8)
def step_columns(layout: MotionLayout) -> NDArray[np.bool_]:
    """Return which columns hold a step to the next frame, bool [D]."""
    steps = np.zeros(layout.dim, dtype=np.bool_)
    for field in ("root_yaw_velocity", "root_xz_velocity", "velocities", "foot_contacts"):
        if layout.has(field):
            steps[layout.slice(field)] = True
    return steps
