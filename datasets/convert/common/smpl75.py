"""SMPL parameters -> the 75 columns of UDE (layout `smpl75`): translation 3, then 24 x 3 axis-angle.

The root's orientation and translation are turned and moved so that forward kinematics of the stored columns
gives canonical joints; rotations are resampled on the sphere and stored as the shortest axis-angle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize, facing, resample, resample_quaternions
from motionloom.datasets.motion.layout import BODY_JOINTS

if TYPE_CHECKING:
    import torch

SMPL_JOINTS = 24


def canonical_smpl75(
    poses: NDArray[np.floating], trans: NDArray[np.floating], body: BodyModel, fps_in: float, fps_out: float
) -> NDArray[np.float32]:
    """SMPL parameters -> canonical columns [T', 75]: translation 3, then 24 x 3 axis-angle.

    `poses` [T, 24, 3] radians and `trans` [T, 3] metres at `fps_in`. `smpl_joints` of the result with the
    same body gives joints with the floor at 0, the first root above the origin and the first heading +Z.
    """
    import roma
    import torch

    turns = roma.rotvec_to_unitquat(torch.from_numpy(np.asarray(poses, dtype=np.float64))).numpy()
    turns = torch.from_numpy(resample_quaternions(turns, fps_in, fps_out))
    trans = resample(np.asarray(trans, dtype=np.float64), fps_in, fps_out)
    joints = smpl_joints(_rotvecs(turns[:, :BODY_JOINTS]), trans, body)
    back = roma.rotvec_to_unitquat(torch.tensor([0.0, -float(facing(joints[:1])[0]), 0.0], dtype=turns.dtype))
    turns[:, 0] = roma.quat_product(back.expand(len(turns), 4), turns[:, 0])
    out = np.empty((len(turns), 3 + 3 * SMPL_JOINTS))
    out[:, :3] = canonicalize(joints)[:, 0] - body.rest_joints()[0]  # the root stands at rest pelvis + trans
    out[:, 3:] = _rotvecs(turns).reshape(len(turns), -1)
    return out.astype(np.float32)


def _rotvecs(turns: torch.Tensor) -> NDArray[np.float64]:
    """Unit quaternions [..., 4] -> axis-angle [..., 3] of at most pi."""
    import roma

    return np.asarray(roma.unitquat_to_rotvec(turns, shortest_arc=True).numpy(), dtype=np.float64)


def upright(
    poses: NDArray[np.floating], trans: NDArray[np.floating], body: BodyModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parameters [T, N, 3] and [T, 3] with Z up, as they are with Y up."""
    import roma
    import torch

    turn = roma.rotvec_to_unitquat(torch.tensor([-np.pi / 2, 0.0, 0.0], dtype=torch.float64))
    root = roma.rotvec_to_unitquat(torch.from_numpy(np.asarray(poses[:, 0], dtype=np.float64)))
    turned = np.array(poses, dtype=np.float64)
    turned[:, 0] = _rotvecs(roma.quat_product(turn.expand(len(root), 4), root))
    pelvis = body.rest_joints()[0]
    return turned, (trans + pelvis)[:, [0, 2, 1]] * [1.0, 1.0, -1.0] - pelvis


def mirrored(
    poses: NDArray[np.floating], trans: NDArray[np.floating], body: BodyModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parameters [T, 24, 3] and [T, 3] of the mirror image: left and right swapped, x negated."""
    swapped = [*body.skeleton.mirror.tolist(), SMPL_JOINTS - 1, SMPL_JOINTS - 2]
    pelvis = body.rest_joints()[0]
    return poses[:, swapped] * [1.0, -1.0, -1.0], (trans + pelvis) * [-1.0, 1.0, 1.0] - pelvis
