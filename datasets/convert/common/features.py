"""Joints of any source -> the features of a sample: the last step that all converters share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName
from motionloom.datasets.motion.canonical import canonicalize, resample, retarget
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError

FIGURE_METRES = (0.5, 4.0)
"""A person's largest extent over a clip lies between these; anything else is a wrong unit."""

MAX_SPEED = 40.0
"""Metres a second. The fastest hand of a person stays below 30; video fits that explode do not."""


def body_of(model: Path | None, skeleton: SkeletonName) -> BodyModel:
    """The user's body model, or the neutral skeleton of the package where none is given."""
    return BodyModel.neutral(skeleton) if model is None else BodyModel.load(model, skeleton)


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
    require_human(joints, fps)
    joints = resample(joints, fps, layout.fps)
    if same_bones:
        joints = retarget(joints, layout.skeleton)
    return encode(canonicalize(joints), layout, None if face is None else resample(face, fps, layout.fps))


def require_human(joints: NDArray[np.floating], fps: float) -> None:
    """`UserError` for NaN, a figure of the wrong size, or joints that jump."""
    if not np.isfinite(joints).all():
        frame, joint = np.argwhere(~np.isfinite(joints).all(axis=-1))[0]
        raise UserError(f"NaN or infinity at frame {frame}, joint {joint}")
    extent = float(np.ptp(joints, axis=1).max())
    if not FIGURE_METRES[0] < extent < FIGURE_METRES[1]:
        raise UserError(f"the figure measures {extent:.3g} m; is the length unit right?")
    if len(joints) > 1:
        speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) * fps
        if speed.max() > MAX_SPEED:
            frame, joint = np.unravel_index(int(speed.argmax()), speed.shape)
            raise UserError(
                f"joint {joint} moves at {speed.max():.0f} m/s at frame {frame}: "
                f"a broken fit, or a wrong frame rate"
            )


def frames_after(frames: int, fps: float, layout: MotionLayout) -> int:
    """Frames of the features of a clip, as `features_of` makes them."""
    return int((frames - 1) * layout.fps / fps + 1e-6) + 1 - (layout.family == "h3d")
