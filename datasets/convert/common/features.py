"""Joints or SMPL parameters of any source -> the columns of a sample: the last step that converters share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import (
    canonicalize,
    require_rate,
    resample,
    resample_quaternions,
    retarget,
)
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.smpl75 import SMPL_JOINTS, smpl75_of
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout

if TYPE_CHECKING:
    import torch


FIGURE_METRES = (0.5, 4.0)
"""A person's largest extent over a clip lies between these; anything else is a wrong unit."""

MAX_SPEED = 40.0
"""Metres a second. The fastest hand of a person stays below 30; video fits that explode do not."""

MOST_JUMPS = 0.01
"""Share of the frames that a joint may jump in: markers are mistaken in good recordings too."""


def features_of(
    joints: NDArray[np.floating],
    fps: float,
    layout: MotionLayout,
    *,
    face: NDArray[np.floating] | None = None,
    same_bones: bool = False,
) -> NDArray[np.float32]:
    """World joints [T, N, 3] in metres, Y up, at `fps` -> features [T', D] at the layout's rate.

    Resampled by time, moved to the canonical place (floor at 0, first root above the origin, first heading
    +Z), encoded. `face` [T, 50] is resampled alike. `same_bones` gives every clip the bone lengths of the
    layout's skeleton. Refuses figures that cannot be a person in metres.
    """
    require_rate(len(joints), fps, layout.fps)
    require_human(joints, fps)
    joints = resample(joints, fps, layout.fps)
    if same_bones:
        joints = retarget(joints, layout.skeleton)
    return encode(canonicalize(joints), layout, None if face is None else resample(face, fps, layout.fps))


def require_human(joints: NDArray[np.floating], fps: float) -> None:
    """`UserError` for NaN, a figure of the wrong size, or joints that jump more than now and then."""
    if not np.isfinite(joints).all():
        frame, joint = np.argwhere(~np.isfinite(joints).all(axis=-1))[0]
        raise UserError(f"NaN or infinity at frame {frame}, joint {joint}")
    # The largest frame counts: lying or squatting, a figure is small in any single one.
    extent = float(np.ptp(joints, axis=1).max())
    if not FIGURE_METRES[0] < extent < FIGURE_METRES[1]:
        raise UserError(f"the figure measures {extent:.3g} m; is the length unit right?")
    if len(joints) > 1:
        # A share of frames, since markers are swapped now and then in good recordings too.
        speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) * fps
        if (speed.max(axis=-1) > MAX_SPEED).mean() > MOST_JUMPS:
            frame, joint = np.unravel_index(int(speed.argmax()), speed.shape)
            raise UserError(
                f"joint {joint} moves at {speed.max():.0f} m/s at frame {frame}: "
                f"a broken fit, or a wrong frame rate"
            )


def frames_after(frames: int, fps: float, layout: MotionLayout) -> int:
    """Frames of the features of a clip, as `features_of` makes them."""
    return int((frames - 1) * layout.fps / fps + 1e-6) + 1 - (layout.family == "h3d")


def canonical_smpl75(
    poses: NDArray[np.floating], trans: NDArray[np.floating], body: BodyModel, fps_in: float, fps_out: float
) -> NDArray[np.float32]:
    """SMPL parameters -> canonical columns [T', 75]: translation 3, then 24 x 3 axis-angle.

    `poses` [T, 24, 3] radians and `trans` [T, 3] metres at `fps_in`. `smpl_joints` of the result with the
    same body gives joints with the floor at 0, the first root above the origin and the first heading +Z.
    """
    import roma
    import torch

    require_rate(len(poses), fps_in, fps_out)
    turns = roma.rotvec_to_unitquat(torch.from_numpy(np.asarray(poses, dtype=np.float64))).numpy()
    turns = torch.from_numpy(resample_quaternions(turns, fps_in, fps_out))
    trans = resample(np.asarray(trans, dtype=np.float64), fps_in, fps_out)
    joints = smpl_joints(_rotvecs(turns[:, :BODY_JOINTS]), trans, body)
    return smpl75_of(roma.unitquat_to_rotmat(turns).numpy(), joints, body.rest_joints()[0])


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
    # Mirrored, an axis-angle (a, b, c) is (a, -b, -c); a translation moves the pelvis, not the origin.
    swapped = [*body.skeleton.mirror.tolist(), SMPL_JOINTS - 1, SMPL_JOINTS - 2]
    pelvis = body.rest_joints()[0]
    return poses[:, swapped] * [1.0, -1.0, -1.0], (trans + pelvis) * [-1.0, 1.0, 1.0] - pelvis
