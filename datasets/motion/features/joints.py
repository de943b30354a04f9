"""Columns of any layout -> joints: motion features are decoded, SMPL parameters pose the neutral skeleton.

SMPL parameters without a shape have no bone lengths of their own: the pose is the motion's, the bones are
those of one neutral adult (`smpl.py`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.canonical import ground, heading
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.features.exact import place
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.schema import UserError


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
    out[..., 2], out[..., 0] = turned.real, turned.imag
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


class JointFlow:
    """`joints_of` for a motion whose columns arrive chunk by chunk.

    The root's heading and place are sums over all frames before. They are carried from chunk to chunk and
    added in the same order, so the joints are, to the bit, those of the whole motion.
    """

    def __init__(self, layout: MotionLayout) -> None:
        self.layout, self._body = layout, layout.without_face() if layout.family != "raw" else layout
        self._angle, self._turning = 0.0, 0.0
        """Sum of the turns before the last frame, and the turn that followed it."""
        self._root, self._going = 0j, 0j
        """Sum and step of the root's way, z + i x; of `h3d` the step is not turned yet."""

    def __call__(self, features: NDArray[np.floating]) -> NDArray[np.float64]:
        """The next columns [T, D] in their own units -> joints [T, N, 3] in metres."""
        if not len(features):
            return np.zeros((0, self.layout.num_joints, 3))
        if self.layout.family == "raw":
            return joints_of(features, self.layout)  # raw parameters say where each frame stands
        body = _without_face(features, self.layout)
        # Sums go on from the last chunk by the same additions as over the whole motion: no rounding differs.
        yaw = np.asarray(body[:, self._body.slice("root_yaw_velocity")][:, 0], dtype=np.float64)
        published = self.layout.family == "h3d"
        angle = _carried(self._angle, self._turning, yaw)
        turn = np.exp((-2j if published else 1j) * angle)
        xz = body[:, self._body.slice("root_xz_velocity")]
        if published:  # a step is seen from the heading of the frame that it leads to
            own = xz[:, 1] + 1j * xz[:, 0]
            steps = np.concatenate([[self._going], own[:-1]]) * turn
            root = self._root + 0j
            way = np.cumsum(np.concatenate([[root + steps[0]], steps[1:]]))
            self._going = own[-1]
        else:
            own = (np.asarray(xz[:, 1], np.float64) + 1j * np.asarray(xz[:, 0], np.float64)) * turn
            way = _carried(self._root, self._going, own)
            self._going = own[-1]
        self._angle, self._turning, self._root = angle[-1], yaw[-1], way[-1]
        return place(body, self._body, turn, way)


def _carried(
    before: complex | np.floating, step: complex | np.floating, steps: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Sum of the steps before each frame, going on from `before`, the sum at the frame before, by `step`."""
    return np.cumsum(np.concatenate([[before + step], steps[:-1]]))
