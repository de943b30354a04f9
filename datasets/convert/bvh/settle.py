"""Unit, upward axis and an added first frame of a motion file, measured on the figures in it.

A unit is the known one that makes the most ordinary adult of the figure; where none makes a person at all,
the scale that makes it 1.7 m tall. The upward axis is that along which heads are above pelvises in most
frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.look import ADULT_METRES, named_unit
from motionloom.datasets.motion.bvh.joint_map import JointMap, Unit, Up, metres
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.plausibility import measure
from motionloom.datasets.motion.skeleton import Skeleton

_ABOVE = 0.8
"""Cosine between an axis and the way from pelvis to head from which a figure stands along it."""
_JUMP_METRES, _JUMP_TIMES = 0.05, 5.0
"""An added frame is so far from the second one, and so much further than later frames are from each other."""
_BLENDED, _LATER = 10, 40
"""Frames that an added one may have been blended into, and the last of those that are looked at for it."""
_STRAIGHT = 0.98
"""Share of their bones' length that stretched limbs reach."""
_SPREAD = 0.3
"""Cosine between both arms, at most: 90 degrees in an A-pose, 180 in a T-pose."""

_NAMED = Skeleton.named("smpl22")
_ARMS, _LEGS = (
    [[_NAMED.index(f"{side}_{joint}") for joint in joints] for side in ("left", "right")]
    for joints in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
)
_PELVIS, _HEAD = _NAMED.index("pelvis"), _NAMED.index("head")


def up_of(clips: Sequence[NDArray[np.floating]]) -> Up:
    """The upward axis of some clips of joints [T, N, 3] in the axes of their files."""
    trunks = np.concatenate([clip[:, _HEAD] - clip[:, _PELVIS] for clip in clips])
    trunks /= np.maximum(np.linalg.norm(trunks, axis=-1, keepdims=True), 1e-9)
    along = (trunks > _ABOVE).sum(axis=0)
    return "z" if along[2] > along[1] else "y"


def settled(joint_map: JointMap, motions: Sequence[BvhMotion]) -> tuple[Unit, Up, float]:
    """Unit and upward axis of a skeleton's files, by some of its clips, and the median height in metres."""
    clips = [joint_map.places(motion) for motion in motions]
    heights = [measure(clip, motion.fps).height for clip, motion in zip(clips, motions, strict=True)]
    height = float(np.median(heights))
    unit = joint_map.unit or named_unit(height) or float(f"{ADULT_METRES / max(height, 1e-6):.4g}")
    return unit, joint_map.up or up_of(clips), height * metres(unit)


def added_frames(joints: NDArray[np.floating]) -> int:
    """Count the frames that a writer put in front of joints [T, N, 3] in metres: a T- or A-pose, from which
    the motion begins with a jump, and the frames into which it was blended.
    """
    if len(joints) < 4:
        return 0
    # The motion's own pace, past the frames that may be blended, is what the first step is compared with.
    steps = np.linalg.norm(np.diff(joints[: _LATER + 1], axis=0), axis=-1).max(axis=-1)
    usual = float(np.median(steps[_BLENDED:] if len(steps) > 2 * _BLENDED else steps[1:]))
    if steps[0] < max(_JUMP_METRES, _JUMP_TIMES * usual):
        return 0
    # A jump alone may be a lost marker: a writer's pose also has straight limbs and spread arms.
    arms = joints[0][_ARMS]
    legs = joints[0][_LEGS]
    ways = arms[:, 2] - arms[:, 0]
    cosine = float(ways[0] @ ways[1] / max(float(np.prod(np.linalg.norm(ways, axis=-1))), 1e-9))
    if cosine > _SPREAD or not all(_is_straight(limb) for limb in (*arms, *legs)):
        return 0
    # The last rough step ends the blend from the added pose into the motion.
    rough = np.flatnonzero(steps[:_BLENDED] > _JUMP_TIMES * usual + 0.1 * _JUMP_METRES)
    return int(rough.max(initial=0)) + 1


def _is_straight(limb: NDArray[np.floating]) -> bool:
    bones = np.linalg.norm(np.diff(limb, axis=0), axis=-1).sum()
    return float(np.linalg.norm(limb[2] - limb[0])) > _STRAIGHT * float(bones)
