"""The pose of the body in each frame: joint positions, and the rotation and stretch of each bone.

A rigid figure brings its rotations, so page, film and pictures show the same body as its GLB file. Bare
joints get rotations by the rule that starts a figure's fit (the smallest turn that points each bone the right
way, a hand's twist shared with its forearm), and their bones may change length from frame to frame: then the
body is stretched along the bone, so that its joints are exactly where the motion has them **[ours]**.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.rigid import RigidMotion, share_twist
from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

Floats = NDArray[np.float64]

LONGEST, SHORTEST = 2.0, 0.5
"""A bone is shown no longer or shorter than so many times its own length; beyond it, only joints follow."""
_NO_BONE = 1e-6


@dataclass(frozen=True, eq=False)
class Posing:
    """T frames of a body on N joints."""

    skeleton: Skeleton
    """Names, parents and the motion's own rest offsets."""
    joints: Floats
    """[T, N, 3], metres."""
    turns: Floats
    """Rotations from the rest pose to the world [T, N, 3, 3]."""

    def bones(self) -> Floats:
        """`turns`, stretched along those bones that are not as long as they were at rest [T, N, 3, 3]."""
        ends, starts = single_bones(self.skeleton)
        rest = self.skeleton.offsets[ends]
        length = np.linalg.norm(rest, axis=-1)
        known = length > _NO_BONE
        ends, starts, rest, length = ends[known], starts[known], rest[known], length[known]
        along = rest / length[:, None]
        now = np.linalg.norm(self.joints[:, ends] - self.joints[:, starts], axis=-1)
        more = np.clip(now / length, SHORTEST, LONGEST) - 1
        out = self.turns.copy()
        line = np.einsum("tnij,nj->tni", self.turns[:, starts], along)
        out[:, starts] += more[..., None, None] * line[..., None] * along[:, None]
        return out


def single_bones(skeleton: Skeleton) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Joints that are their parent's only child, and these parents."""
    parents = np.asarray(skeleton.parents)
    ends = np.array(
        [j for j, p in enumerate(parents) if p >= 0 and (parents == p).sum() == 1], dtype=np.int64
    )
    return ends, parents[ends]


def human_skeleton(parents: Sequence[int]) -> Skeleton | None:
    """The skeleton that has a body and these parents, or None."""
    key = tuple(int(parent) for parent in parents)
    known = (Skeleton.named(name) for name in ("smplx52", "smpl22"))
    return next((skeleton for skeleton in known if skeleton.parents == key), None)


def posing_of(joints: NDArray[np.floating], skeleton: Skeleton, figure: RigidMotion | None = None) -> Posing:
    """The body's pose at joints [T, N, 3] in metres; `figure` has their rotations, where they are known."""
    if figure is not None:
        if figure.joints.shape != joints.shape:
            raise UserError(
                f"a figure of {list(figure.joints.shape)} joints for a motion of {list(joints.shape)}"
            )
        own, local, root = figure.skeleton, figure.rotations, figure.root
    else:
        own = skeleton.with_lengths_of(np.asarray(joints, np.float64))
        local = share_twist(joints_to_rotations(joints, own), own)
        root = np.asarray(joints, np.float64)[:, 0]
    places, turns = forward_kinematics(local, root, own.offsets, own.parents)
    return Posing(own, places if figure is not None else np.asarray(joints, np.float64), turns)
