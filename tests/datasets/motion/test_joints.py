"""Layouts and the joints of their columns, at once and in chunks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from motionloom.datasets.motion.canonical import turn
from motionloom.datasets.motion.features.joints import JointFlow, joints_of, local_joints_of
from motionloom.datasets.motion.layout import LAYOUTS, MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, make_clip, make_sample

FLOWING = [
    MotionLayout.named("body133"),
    MotionLayout.named("wholebody363"),
    MotionLayout.named("wholebody363", family="h3d"),
    MotionLayout.named("h3d263"),
    MotionLayout.named("smpl75"),
]


@pytest.mark.parametrize("name", LAYOUTS)
def test_without_face_is_the_layout_of_the_body_and_hand_columns(name: str) -> None:
    layout = MotionLayout.named(name, fps=12.5)
    if layout.family == "raw" and layout.has("face"):
        with pytest.raises(UserError, match="no counterpart without the face"):
            layout.without_face()
        return
    bare, columns = layout.without_face(), layout.part("bodyhand")
    assert (bare.dim, bare.fps, bare.family) == (len(columns), 12.5, layout.family)
    assert bare.skeleton_name == layout.skeleton_name and not bare.has("face")
    numbers = np.arange(layout.dim)
    for field, _ in bare.fields:  # the same columns under the same name
        np.testing.assert_array_equal(numbers[columns][bare.slice(field)], numbers[layout.slice(field)])
    assert (bare is layout) == (not layout.has("face"))


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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("layout", FLOWING, ids=lambda layout: f"{layout.name} {layout.family}")
def test_chunks_are_the_whole_to_the_bit(layout: MotionLayout, dtype: type) -> None:
    features = np.random.default_rng(0).normal(size=(61, layout.dim)).astype(dtype)
    cuts = [0, 1, 2, 9, 9, 30, 60, 61]
    flow = JointFlow(layout)
    made = [flow(features[a:b]) for a, b in pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(made), joints_of(features, layout))


def test_columns_of_body_and_hands_alone() -> None:
    layout = MotionLayout.named("wholebody363")
    features = np.random.default_rng(1).normal(size=(20, layout.dim)).astype(np.float32)
    body = features[:, layout.part("bodyhand")]
    flow = JointFlow(layout)
    np.testing.assert_array_equal(np.concatenate([flow(body[:7]), flow(body[7:])]), joints_of(body, layout))
    with pytest.raises(UserError, match="363 columns"):
        flow(features[:, :5])
