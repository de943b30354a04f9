"""UDE's 75-d SMPL vector of a generated clip: translation 3, then 24 axis-angles (UDE section 4.1).

The generator poses joints by rotations, so these are stored as they are, twists included, instead of being
fitted to the joints. SMPL has one body for all clips here (the vector holds no shape): body sizes do not
differ. Its last two joints, the hands, stay at rest **[ours]**.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import canonicalize, facing
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.synth.maths import Array, rot_y

SMPL_JOINTS = 24
_REST_ROOT = Skeleton.named("smpl22").rest_joints[0]


def smpl75_of(rotations: Array, joints: Array) -> NDArray[np.float32]:
    """Columns [T, 75] of local rotations [T, N >= 22, 3, 3] and the joints [T, N, 3] they pose.

    Canonical: floor at 0, the first root above the origin, the first heading +Z, as for joints.
    """
    import roma
    import torch

    body = joints[:, :BODY_JOINTS]
    local = rotations[:, :BODY_JOINTS].copy()
    local[:, 0] = rot_y(-float(facing(body[:1])[0])) @ local[:, 0]
    turns = roma.rotmat_to_rotvec(torch.from_numpy(np.ascontiguousarray(local))).numpy()
    out = np.zeros((len(joints), 3 + 3 * SMPL_JOINTS))
    # SMPL adds the translation to every joint: the root stands at its rest place + translation.
    out[:, :3] = canonicalize(body)[:, 0] - _REST_ROOT
    out[:, 3 : 3 + 3 * BODY_JOINTS] = turns.reshape(len(joints), -1)
    return out.astype(np.float32)
