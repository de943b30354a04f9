"""A rigid motion as SMPL-X parameters in AMASS's form: npz files that SMPL-X tools and add-ons read.

| array | shape | meaning |
|---|---|---|
| `poses` | [T, 165] | axis-angle: root, body 21, jaw, eyes 2, hands 2 x 15 |
| `root_orient`, `pose_body`, `pose_jaw`, `pose_eye`, `pose_hand` | [T, 3], 63, 3, 6, 90 | the same, apart |
| `trans` | [T, 3] | metres, what the model adds to every vertex |
| `betas` | [16] | zeros: the model's mean shape |
| `mocap_frame_rate`, `mocap_time_length`, `gender`, `surface_model_type` | | as AMASS has them |

Z is up, as in AMASS: `root_orient` and `trans` are turned there. The pose is solved on the bones of the body
that will wear it: those of the user's SMPL-X model where one is given, else the package's neutral adult. The
path is scaled with the legs, so feet stay on the floor. Without a model the place of its pelvis is not known:
`trans` is then the pelvis' own place (a model puts its pelvis about 0.35 m below it), with one it is exact.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.motion.body.retarget import on_bones
from motionloom.datasets.motion.body.rigid import FitError, RigidMotion
from motionloom.datasets.motion.body.smpl import FINGERS, BodyModel
from motionloom.datasets.motion.layout import BODY_JOINTS

_BETAS = 16


def smplx_parameters(
    motion: RigidMotion, fps: float, body: BodyModel | None = None
) -> tuple[dict[str, Any], FitError]:
    """The arrays of the file, and how far the posed body is from the motion on the body's bones."""
    from scipy.spatial.transform import Rotation

    name = motion.skeleton.name
    if name not in ("smpl22", "smplx52"):
        raise UserError(f"skeleton {name} has no SMPL-X parameters; smpl22 and smplx52 have")
    if body is None:
        body = BodyModel.neutral("smplx52" if name == "smplx52" else "smpl22")
    count = len(motion.skeleton)
    if len(body.skeleton) < count:
        raise UserError(f"the body model has {len(body.skeleton)} joints, the motion {count}: use SMPL-X")
    rest = body.rest_joints()[:count]
    worn = on_bones(motion, motion.skeleton.bones(rest))
    frames = len(worn.root)
    upright = Rotation.from_euler("x", 90, degrees=True)  # Y up to Z up: +Z ahead becomes -Y
    vectors = np.zeros((frames, BODY_JOINTS + FINGERS, 3))
    turns = Rotation.from_matrix(worn.rotations.reshape(-1, 3, 3)).as_rotvec()
    vectors[:, :count] = turns.reshape(frames, count, 3)
    vectors[:, 0] = (upright * Rotation.from_matrix(worn.rotations[:, 0])).as_rotvec()
    flat = vectors.reshape(frames, -1).astype(np.float32)
    trunk = flat[:, 3 : 3 * BODY_JOINTS]
    hands = flat[:, 3 * BODY_JOINTS :]
    jaw = np.zeros((frames, 3), np.float32)
    eyes = np.zeros((frames, 6), np.float32)
    arrays = {
        "poses": np.concatenate([flat[:, :3], trunk, jaw, eyes, hands], axis=1),
        "root_orient": flat[:, :3],
        "pose_body": trunk,
        "pose_jaw": jaw,
        "pose_eye": eyes,
        "pose_hand": hands,
        # A model turns its body about the pelvis, which stays at rest pelvis + trans.
        "trans": (upright.apply(worn.root) - rest[0]).astype(np.float32),
        "betas": np.zeros(_BETAS, np.float32),
        "gender": np.array("neutral"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(float(fps)),
        "mocap_time_length": np.array(frames / fps),
    }
    return arrays, worn.error


def write_smplx(path: Path, motion: RigidMotion, fps: float, body: BodyModel | None = None) -> FitError:
    """Write the file; the error is that of `smplx_parameters`."""
    arrays, error = smplx_parameters(motion, fps, body)
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)
    return error
