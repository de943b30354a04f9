"""Joints to features and back, for both families (HumanTOMATO section 4.2).

`exact` (exact.py) is invertible and keeps the number of frames; `h3d` (h3d.py) equals the published HumanML3D
and HumanTOMATO features, has one frame less than the joints, and retargets to the layout's skeleton first.
The layout says which family an array holds. Both work on whole sequences and any leading dimensions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.features.exact import encode_exact, place
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import FACE_DIMS, MotionLayout
from motionloom.datasets.schema import UserError

_GROUP_FRAMES = 800
"""Clips are encoded in groups of about so many frames. Measured: larger groups leave the cache and run at
half the speed, single clips of 200 frames pay as much for calls as for arithmetic."""


def encode(
    joints: NDArray[np.floating], layout: MotionLayout, face: NDArray[np.floating] | None = None
) -> NDArray[np.float32]:
    """Canonical joints [..., T, N, 3] in metres -> features [..., T', D]: T' = T (exact) or T - 1 (h3d).

    `face` [..., T, 50] fills the layout's face columns; without it they are 0. Joints are not moved: call
    `canonicalize` first (h3d does its own).
    """
    _check_family(layout)
    _check_joints(joints, layout)
    kernel = encode_h3d if layout.family == "h3d" else encode_exact
    frames = joints.shape[-3] - (layout.family == "h3d")
    clips = joints.reshape(-1, *joints.shape[-3:])
    group = max(1, _GROUP_FRAMES // joints.shape[-3])
    out = np.empty((len(clips), frames, layout.dim), dtype=np.float32)
    for start in range(0, len(clips), group):
        out[start : start + group] = kernel(clips[start : start + group], layout)
    out = out.reshape(*joints.shape[:-3], frames, layout.dim)
    if face is not None:
        if not layout.has("face"):
            raise UserError(f"layout {layout.name} has no face columns; wholebody363 has")
        if face.shape != (*joints.shape[:-2], FACE_DIMS):
            raise UserError(f"face of shape {list(face.shape)} does not fit joints {list(joints.shape)}")
        out[..., layout.slice("face")] = face[..., :frames, :]
    return out


def decode(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.float64]:
    """Features [..., T, D] (not normalised) -> joints [..., T, N, 3] in metres, float64.

    Frame 0 stands above the origin with heading +Z.
    """
    _check_family(layout)
    if features.ndim < 2 or features.shape[-1] != layout.dim:
        raise UserError(
            f"layout {layout.name} has {layout.dim} columns, but these features are {list(features.shape)}"
        )
    return Decoder(layout)(features)


class Decoder:
    """`decode` for a motion whose columns arrive chunk by chunk.

    The root's heading and place are sums over all frames before. They are carried from chunk to chunk and
    added in the same order, so the joints are, to the bit, those of the whole motion.
    """

    def __init__(self, layout: MotionLayout) -> None:
        self.layout = layout
        self._angle, self._turning = np.asarray(0.0), np.asarray(0.0)
        """Sum of the turns before the last frame, and the turn that followed it."""
        self._root, self._going = np.asarray(0j), np.asarray(0j)
        """Sum and step of the root's way, z + i x; of `h3d` the step is not turned yet."""

    def __call__(self, features: NDArray[np.floating]) -> NDArray[np.float64]:
        """The next columns [..., T, D] in their own units -> joints [..., T, N, 3] in metres."""
        if not features.shape[-2]:
            return np.zeros((*features.shape[:-1], self.layout.num_joints, 3))
        yaw = np.asarray(features[..., self.layout.slice("root_yaw_velocity")][..., 0], dtype=np.float64)
        published = self.layout.family == "h3d"
        angle = _carried(self._angle, self._turning, yaw)
        turn = np.exp((-2j if published else 1j) * angle)
        xz = features[..., self.layout.slice("root_xz_velocity")]
        if published:  # a step is seen from the heading of the frame that it leads to
            own = xz[..., 1] + 1j * xz[..., 0]
            going = np.broadcast_to(self._going[..., None], (*own.shape[:-1], 1))
            steps = np.concatenate([going, own[..., :-1]], axis=-1) * turn
            steps[..., 0] += self._root
            way = np.cumsum(steps, axis=-1)
        else:
            own = (np.asarray(xz[..., 1], np.float64) + 1j * np.asarray(xz[..., 0], np.float64)) * turn
            way = _carried(self._root, self._going, own)
        self._angle, self._turning = angle[..., -1], yaw[..., -1]
        self._root, self._going = way[..., -1], own[..., -1]
        return place(features, self.layout, turn, way)


def _carried(
    before: NDArray[np.inexact], step: NDArray[np.inexact], steps: NDArray[np.inexact]
) -> NDArray[np.inexact]:
    """Sum of the steps before each frame, going on from `before`, the sum at the frame before, by `step`."""
    first = np.broadcast_to((before + step)[..., None], (*steps.shape[:-1], 1))
    return np.cumsum(np.concatenate([first, steps[..., :-1]], axis=-1), axis=-1)


def face_of(features: NDArray[np.floating], layout: MotionLayout) -> NDArray[np.floating]:
    """The expression columns [..., T, 50] of features [..., T, D]."""
    return features[..., layout.slice("face")]


def _check_family(layout: MotionLayout) -> None:
    if layout.family == "raw" or not layout.has("root_yaw_velocity"):
        raise UserError(
            f"layout {layout.name} (family '{layout.family}') is raw parameters; convert it to joints first"
        )
    if layout.family == "exact" and layout.has("rotations_6d"):
        raise UserError(f"layout {layout.name} holds rotations and contacts, which only the h3d family has")


def _check_joints(joints: NDArray[np.floating], layout: MotionLayout) -> None:
    wanted = (layout.num_joints, 3)
    least = 2 if layout.family == "h3d" else 1
    if joints.ndim < 3 or joints.shape[-2:] != wanted:
        raise UserError(
            f"layout {layout.name} needs joints [..., T, {wanted[0]}, 3], but these are {list(joints.shape)}"
        )
    if joints.shape[-3] < least:
        raise UserError(
            f"a clip of {joints.shape[-3]} frames is too short: the {layout.family} family needs {least}"
        )
    if not np.isfinite(joints).all():
        raise UserError("joints hold NaN or infinite values")
