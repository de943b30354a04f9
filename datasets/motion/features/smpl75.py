"""The columns of layout `smpl75`, UDE's SMPL parameters: translation 3, then 24 axis-angles (section 4.1).

Canonical: the floor at 0, the first root above the origin, the first heading +Z.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.retarget import on_bones
from motionloom.datasets.motion.body.rigid import fit_rigid
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize, facing
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton

SMPL_JOINTS = 24


def smpl75_of(
    rotations: NDArray[np.floating], joints: NDArray[np.floating], rest_root: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Columns [T, 75] of local rotations [T, N, 3, 3] and the joints [T, M, 3] that they pose, N and M 22 or
    more, in any place.

    Rotations are stored as they are, twists included: SMPL's 24, or of any other number the body's 22, with
    SMPL's last two, the hands, at rest [ours]. `rest_root` [3] is the root of the body at rest:
    SMPL adds the translation to every joint.
    """
    import roma
    import torch

    count = SMPL_JOINTS if rotations.shape[1] == SMPL_JOINTS else BODY_JOINTS
    local = rotations[:, :count].astype(np.float64)
    angle = -float(facing(joints[:1])[0])
    local[:, 0] = (
        roma.rotvec_to_rotmat(torch.tensor([0.0, angle, 0.0], dtype=torch.float64)).numpy() @ local[:, 0]
    )
    turns = roma.rotmat_to_rotvec(torch.from_numpy(np.ascontiguousarray(local))).numpy()
    out = np.zeros((len(joints), 3 + 3 * SMPL_JOINTS))
    out[:, :3] = canonicalize(joints[:, :BODY_JOINTS])[:, 0] - rest_root
    out[:, 3 : 3 + 3 * turns.shape[1]] = turns.reshape(len(joints), -1)
    return out.astype(np.float32)


def fit_smpl75(joints: NDArray[np.floating]) -> NDArray[np.float32]:
    """Columns [T, 75] of joints [T, N >= 22, 3] in metres alone: the neutral body, as near as it poses."""
    body = BodyModel.neutral("smpl22")
    rest = body.rest_joints()
    motion = on_bones(fit_rigid(joints[:, :BODY_JOINTS], body.skeleton), body.skeleton.bones(rest))
    return smpl75_of(motion.rotations, motion.joints, rest[0])


def joints24_of(columns: NDArray[np.floating]) -> NDArray[np.float64]:
    """SMPL's joints [..., T, 24, 3] of columns [..., T, 75], on the neutral body with our hands."""
    turns = columns[..., 3:].reshape(*columns.shape[:-1], SMPL_JOINTS, 3)
    return smpl_joints(turns, columns[..., :3], _neutral24())


@cache
def _neutral24() -> BodyModel:
    body = Skeleton.named("smpl22")
    whole = Skeleton.named("smplx52")
    names = body.joints
    parents = body.parents
    rest = body.rest
    for side in ("left", "right"):
        knuckles = [whole.index(f"{side}_{finger}1") for finger in ("index", "middle", "ring", "pinky")]
        x, y, z = whole.offsets[knuckles].mean(axis=0).tolist()
        names = (*names, f"{side}_hand")
        parents = (*parents, body.index(f"{side}_wrist"))
        rest = (*rest, (x, y, z))
    named = Skeleton("smpl24", names, parents, rest)
    return replace(
        BodyModel.neutral("smpl22"),
        skeleton=named,
        template=named.rest_joints,
        directions=np.zeros((len(named), 3, 0)),
    )
