"""Columns of any layout -> joints: motion features are decoded, SMPL parameters pose the neutral skeleton.

SMPL parameters without a shape have no bone lengths of their own: the pose is the motion's, the bones are
those of one neutral adult (`smpl.py`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.canonical import ground, heading
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout


def joints_of(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64]:
    """Return joints [..., T, N, 3] in metres of columns [..., T, D] of `layout` in their own units.

    The columns are all of the layout's, or those of its body and hands (`layout.part("bodyhand")`). Features
    begin above the origin with heading +Z; raw parameters stay in their own axes, where
    `canonical.canonicalize` moves them if needed.
    """
    body = _without_face(features, layout)
    return _posed(features, layout) if layout.family == "raw" else decode(body, layout.without_face())


def _without_face(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.floating]:
    """The columns of body and hands."""
    columns = layout.part("bodyhand")
    if features.ndim < 2 or features.shape[-1] not in (layout.dim, len(columns)):
        raise UserError(
            f"layout {layout.name} has {layout.dim} columns, but these features are {list(features.shape)}"
        )
    return features if features.shape[-1] == len(columns) else features[..., columns]


def local_joints_of(joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """Joints [..., T, N, 3] from the root, turned into the smoothed heading: the pose without its path."""
    out = np.array(joints, dtype=np.float64)
    turned = ground(out)
    turned = (turned - turned[..., :1]) * np.exp(-1j * heading(out, fps))[..., None]
    out[..., 2] = turned.real
    out[..., 0] = turned.imag
    out[..., 1] -= out[..., :1, 1]
    return out


def rotations_of(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64] | None:
    """Local rotations [..., T, N, 3, 3] of columns [..., T, D], where the layout has true ones.

    Raw SMPL parameters do. The 6-D rotations of the h3d family are computed from positions by the smallest
    turn, and know no more than these: None, as for the exact family.
    """
    if layout.family != "raw" or features.shape[-1] != layout.dim:
        return None
    from scipy.spatial.transform import Rotation

    vectors = _rotation_vectors(features, layout)
    turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.asarray(turns.reshape(*vectors.shape, 3), dtype=np.float64)


def _posed(motion: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64]:
    """Raw SMPL or SMPL-X parameters on the neutral skeleton, in the source's own axes."""
    # Without the face's columns the fields after them would lie elsewhere.
    if motion.shape[-1] != layout.dim:
        raise UserError(f"layout {layout.name} is posed from all of its {layout.dim} columns")
    skeleton: SkeletonName = "smpl22" if layout.has("pose") else "smplx52"
    trans = np.asarray(motion[..., layout.slice("trans")], np.float64)
    return smpl_joints(_rotation_vectors(motion, layout), trans, BodyModel.neutral(skeleton))


def _rotation_vectors(motion: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64]:
    """The pose [..., T, N, 3] of raw SMPL or SMPL-X parameters, as far as the skeleton goes."""

    def turns(field: str) -> NDArray[np.float64]:
        columns = np.asarray(motion[..., layout.slice(field)], np.float64)
        return columns.reshape(*columns.shape[:-1], -1, 3)

    if layout.has("pose"):
        return turns("pose")[..., :BODY_JOINTS, :]
    return np.concatenate([turns(f) for f in ("root_orient", "pose_body", "pose_hand")], axis=-2)
