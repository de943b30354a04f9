"""Forward kinematics against a slow loop, rotations from joints against forward kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations, swing
from motionloom.datasets.motion.skeleton import Skeleton

NAMES = ["smpl22", "smplx52"]


def poses(skeleton: Skeleton, frames: int, seed: int, size: float = 0.6) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(scale=size, size=(frames * len(skeleton), 3))
    return Rotation.from_rotvec(vectors).as_matrix().reshape(frames, len(skeleton), 3, 3)


@pytest.mark.parametrize("name", NAMES)
def test_forward_kinematics_equals_a_loop_over_frames_and_joints(name: str) -> None:
    skeleton = Skeleton.named(name)
    local = poses(skeleton, 4, seed=0)
    root = np.random.default_rng(1).normal(size=(4, 3))
    joints, world = forward_kinematics(local, root, skeleton.offsets, skeleton.parents)
    for frame in range(4):
        turned, place = [local[frame, 0]], [root[frame]]
        for joint, parent in enumerate(skeleton.parents[1:], start=1):
            place.append(place[parent] + turned[parent] @ skeleton.offsets[joint])
            turned.append(turned[parent] @ local[frame, joint])
        np.testing.assert_allclose(joints[frame], place, atol=1e-12)
        np.testing.assert_allclose(world[frame], turned, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
@given(seed=st.integers(0, 2**31 - 1), size=st.floats(0.0, 3.0))
@settings(max_examples=15, deadline=None)
def test_rotations_of_posed_joints_pose_them_again(name: str, seed: int, size: float) -> None:
    skeleton = Skeleton.named(name)
    root = np.random.default_rng(seed).normal(size=(5, 3))
    joints, _ = forward_kinematics(poses(skeleton, 5, seed, size), root, skeleton.offsets, skeleton.parents)
    local = joints_to_rotations(joints, skeleton)
    again, _ = forward_kinematics(local, root, skeleton.offsets, skeleton.parents)
    np.testing.assert_allclose(again, joints, atol=1e-6)
    check_rotations(local)


@pytest.mark.parametrize("name", NAMES)
def test_the_rest_pose_and_a_collapsed_figure_are_no_rotation(name: str) -> None:
    skeleton = Skeleton.named(name)
    still = np.broadcast_to(np.eye(3), (len(skeleton), 3, 3))
    np.testing.assert_allclose(joints_to_rotations(skeleton.rest_joints, skeleton), still, atol=1e-9)
    np.testing.assert_allclose(joints_to_rotations(np.zeros((len(skeleton), 3)), skeleton), still, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_degenerate_figures_give_rotations_without_nan(name: str) -> None:
    skeleton = Skeleton.named(name)
    rest = skeleton.rest_joints
    folded = rest.copy()
    knee, ankle = skeleton.index("left_knee"), skeleton.index("left_ankle")
    folded[ankle] = folded[knee] - (rest[ankle] - rest[knee])
    line = np.zeros_like(rest)
    line[:, 1] = np.arange(len(rest))
    figures = np.stack(
        [-rest, folded, line, 1e-12 * rest, np.where(np.arange(len(rest))[:, None] > 9, 0, rest)]
    )
    check_rotations(joints_to_rotations(figures, skeleton))


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_swing_is_the_smallest_rotation_between_two_directions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    old, new = rng.normal(size=(2, 3, 12))
    new[:, 0] = old[:, 0]
    new[:, 1] = -old[:, 1]
    new[:, 2] = -old[:, 2] + 1e-7
    old /= np.linalg.norm(old, axis=0)
    new /= np.linalg.norm(new, axis=0)
    matrices = np.moveaxis(swing(old, new), -1, 0)
    np.testing.assert_allclose(np.einsum("nij,jn->in", matrices, old), new, atol=1e-7)
    check_rotations(matrices, atol=1e-6)
    angle = np.arccos(np.clip((old * new).sum(axis=0), -1, 1))
    np.testing.assert_allclose(Rotation.from_matrix(matrices).magnitude(), angle, atol=1e-6)


def check_rotations(matrices: NDArray[np.float64], atol: float = 1e-9) -> None:
    assert np.isfinite(matrices).all()
    eye = np.broadcast_to(np.eye(3), matrices.shape)
    np.testing.assert_allclose(matrices @ matrices.swapaxes(-1, -2), eye, atol=atol)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=atol)
