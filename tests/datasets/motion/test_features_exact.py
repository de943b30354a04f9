"""The exact family: round trips, column meanings, invariances, errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import canonicalize, ground, turn
from motionloom.datasets.motion.features.codec import decode, encode, face_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError

BODY = MotionLayout.named("body133")


def clip(layout: MotionLayout, frames: int, turns: float, seed: int = 0) -> NDArray[np.float64]:
    """A swaying figure [T, N, 3] that turns left `turns` times, unevenly, while its root wanders."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / layout.fps
    shape = (layout.num_joints, 3)
    sway = 0.06 * np.sin(rng.uniform(1, 9, shape) * time[:, None, None] + rng.uniform(0, 6, shape))
    joints = layout.skeleton.rest_joints + sway
    angle = 2 * np.pi * turns * np.linspace(0, 1, frames) + 0.3 * np.sin(3 * time)
    plane = ground(joints) * np.exp(1j * angle)[:, None]
    plane += (1.5 * time * np.exp(1j * rng.uniform(0, 6)) + np.sin(time))[:, None]
    joints[..., 2], joints[..., 0] = plane.real, plane.imag
    return canonicalize(joints)


@given(
    name=st.sampled_from(["body133", "wholebody313", "wholebody363"]),
    fps=st.sampled_from([20.0, 30.0, 60.0]),
    turns=st.floats(-4, 4),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=25, deadline=None)
def test_ten_seconds_come_back_within_a_tenth_of_a_millimetre(
    name: str, fps: float, turns: float, seed: int
) -> None:
    layout = MotionLayout.named(name, fps=fps)
    joints = clip(layout, int(10 * fps), turns, seed)
    features = encode(joints, layout)
    assert features.shape == (len(joints), layout.dim)
    assert features.dtype == np.float32
    assert np.abs(decode(features, layout) - joints).max() < 1e-4


def test_columns_of_a_circle_to_the_left() -> None:
    """Forward speed in z, none in x, a constant yaw, a still pose, one root velocity."""
    frames, rate, speed = 100, 0.05, 0.04
    angle = rate * np.arange(frames)
    plane = ground(BODY.skeleton.rest_joints) * np.exp(1j * angle)[:, None]
    plane += np.concatenate([[0], np.cumsum(speed * np.exp(1j * angle))[:-1]])[:, None]
    joints = np.empty((frames, 22, 3))
    joints[..., 2], joints[..., 0] = plane.real, plane.imag
    joints[..., 1] = BODY.skeleton.rest_joints[:, 1] + 0.9
    features = encode(joints, BODY)
    np.testing.assert_allclose(features[:, BODY.slice("root_yaw_velocity")], rate, atol=1e-6)
    np.testing.assert_allclose(features[:, BODY.slice("root_xz_velocity")], [[0, speed]] * frames, atol=1e-6)
    np.testing.assert_allclose(features[:, BODY.slice("root_height")], 0.9, atol=1e-6)
    still = BODY.skeleton.rest_joints[1:] + np.array([0, 0.9, 0])
    np.testing.assert_allclose(features[:, BODY.slice("positions")], [still.ravel()] * frames, atol=1e-6)
    root = features[:, BODY.slice("velocities")][:, :3]
    np.testing.assert_allclose(root, [[0, 0, speed]] * frames, atol=1e-6)


def test_velocities_are_the_steps_in_the_heading_frame_and_the_last_frame_repeats() -> None:
    joints = clip(BODY, 80, 1.2)
    features = encode(joints, BODY)
    back = decode(features, BODY)
    heading = np.concatenate([[0], np.cumsum(features[:-1, 0].astype(np.float64))])
    for frame in (0, 20, 78):
        step = turn(back[frame + 1] - back[frame], -heading[frame])
        np.testing.assert_allclose(features[frame, BODY.slice("velocities")], step.ravel(), atol=1e-6)
    for field in ("root_yaw_velocity", "root_xz_velocity", "velocities"):
        columns = BODY.slice(field)
        np.testing.assert_array_equal(features[-1, columns], features[-2, columns])


def test_batches_and_any_leading_dimensions_equal_single_clips() -> None:
    layout = MotionLayout.named("wholebody363")
    joints = np.stack([clip(layout, 50, turns, seed) for seed, turns in enumerate((0.0, 1.0, -2.0, 3.0))])
    batch = encode(joints.reshape(2, 2, 50, 52, 3), layout)
    assert batch.shape == (2, 2, 50, 363)
    for index, one in enumerate(joints):
        np.testing.assert_allclose(batch[index // 2, index % 2], encode(one, layout), atol=1e-7)
    np.testing.assert_allclose(decode(batch, layout).reshape(joints.shape), joints, atol=1e-4)


def test_float32_joints_a_collapsed_figure_and_few_frames() -> None:
    joints = clip(BODY, 200, 2.0).astype(np.float32)
    assert np.abs(decode(encode(joints, BODY), BODY) - joints).max() < 1e-4
    np.testing.assert_array_equal(encode(np.zeros((5, 22, 3)), BODY), 0.0)
    for frames in (1, 2, 3):
        few = joints[:frames]
        np.testing.assert_allclose(decode(encode(few, BODY), BODY), few, atol=1e-5)


def test_face_columns() -> None:
    layout = MotionLayout.named("wholebody363")
    joints = clip(layout, 20, 0.0)
    face = np.random.default_rng(0).normal(size=(20, 50)).astype(np.float32)
    features = encode(joints, layout, face)
    np.testing.assert_array_equal(face_of(features, layout), face)
    np.testing.assert_array_equal(face_of(encode(joints, layout), layout), 0.0)
    np.testing.assert_array_equal(features[:, :313], encode(joints, layout)[:, :313])
    with pytest.raises(UserError, match=r"expected \[20, 50\]"):
        encode(joints, layout, face[:-1])
    with pytest.raises(UserError, match="no face columns"):
        encode(clip(BODY, 20, 0.0), BODY, face)


def test_errors_name_the_layout_and_the_fix() -> None:
    joints = clip(BODY, 20, 0.0)
    with pytest.raises(UserError, match=r"wholebody313 needs joints \[\.\.\., T, 52, 3\]"):
        encode(joints, MotionLayout.named("wholebody313"))
    with pytest.raises(UserError, match="only the h3d family"):
        encode(joints, MotionLayout.named("h3d263", family="exact"))
    with pytest.raises(UserError, match="raw parameters"):
        encode(joints, MotionLayout.named("smpl75"))
    with pytest.raises(UserError, match="family 'raw'"):
        encode(joints, MotionLayout.named("body133", family="raw"))
    with pytest.raises(UserError, match="has 133 columns"):
        decode(np.zeros((5, 263)), BODY)
    with pytest.raises(UserError, match="too short"):
        encode(joints[:0], BODY)
    joints[3, 4, 1] = np.nan
    with pytest.raises(UserError, match="NaN"):
        encode(joints, BODY)
