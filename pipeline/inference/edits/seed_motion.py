"""What a motion goes on from, of a clip in a file (`contract/generation.py`, `SeededGenerator`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.edits.clips import read_clip


def read_seed_motion(path: Path, layout: MotionLayout) -> NDArray[np.float32]:
    """The layout's columns [T, D] of a clip that `read_clip` reads, at the layout's frame rate.

    Hands that the clip does not have are at rest, and so is its face.
    """
    clip = read_clip(path)
    if layout.family == "raw":
        raise UserError(
            f"{path}: a clip has joints, and this model goes on from the rotations of layout {layout.name}; "
            f"leave the seed motion out, or give columns [T, {layout.dim}] in Python"
        )
    joints = clip.joints if layout.num_joints <= clip.joints.shape[1] else with_resting_hands(clip.joints)
    face = clip.face if layout.has("face") else None
    return features_of(joints[:, : layout.num_joints], clip.fps, layout, face=face)
