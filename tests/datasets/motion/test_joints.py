"""Joints of any layout's columns, against the joints that the columns were made from."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.motion.canonical import turn
from motionloom.datasets.motion.joints import joints_of, local_joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, make_clip, make_sample


@pytest.mark.parametrize("name", ["body133", "wholebody313", "wholebody363", "smpl75"])
def test_columns_give_back_the_joints(name: str) -> None:
    config = SynthConfig(clips=3, seed=5, layout=name, fps=20, actions=["walk", "turn", "dance"])  # type: ignore[arg-type]
    layout = config.motion_layout
    for i in range(3):
        motion, joints = make_sample(i, config).motion, make_clip(i, config).joints
        found = joints_of(motion, layout)
        # Single precision, added up over a clip by the velocities of the root.
        np.testing.assert_allclose(found, joints, atol=2e-4)
        np.testing.assert_array_equal(joints_of(motion[:, layout.part("bodyhand")], layout), found)


def test_batches_of_clips_equal_single_ones() -> None:
    config = SynthConfig(clips=2, layout="smpl75", fps=20)
    clips = np.stack([make_sample(i, config).motion[:20] for i in range(2)])
    together = joints_of(clips, config.motion_layout)
    for one, motion in zip(together, clips, strict=True):
        np.testing.assert_allclose(one, joints_of(motion, config.motion_layout), atol=1e-12)


def test_columns_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"smpl75 has 75 columns, but .* \[4, 74\]"):
        joints_of(np.zeros((4, 74)), MotionLayout.named("smpl75"))
    raw = MotionLayout.named("smplx322")
    with pytest.raises(UserError, match="all of its 322 columns"):
        joints_of(np.zeros((4, len(raw.part("bodyhand")))), raw)


def test_a_pose_does_not_depend_on_place_and_heading() -> None:
    """Against the positions that exact features hold, and of the same motion elsewhere."""
    config = SynthConfig(clips=1, layout="body133", actions=["turn"])
    layout, motion = config.motion_layout, make_sample(0, config).motion
    joints = joints_of(motion, layout)
    local = local_joints_of(joints, layout.fps)
    positions = motion[:, layout.slice("positions")].reshape(len(motion), -1, 3).astype(np.float64)
    positions[..., 1] -= motion[:, layout.slice("root_height")]
    np.testing.assert_allclose(local[:, 1:], positions, atol=2e-4)
    elsewhere = turn(joints, 1.1) + np.array([3.0, 0.5, -2.0])
    np.testing.assert_allclose(local_joints_of(elsewhere, layout.fps), local, atol=1e-9)
