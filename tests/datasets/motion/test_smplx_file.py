"""SMPL-X files, read back by forward kinematics of the body that wears them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid, with_offsets
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.body.smplx_file import smplx_parameters, write_smplx
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

Floats = NDArray[np.float64]


def posed(skeleton: Skeleton, frames: int = 12, seed: int = 0) -> tuple[Floats, RigidMotion]:
    """Local rotations of a smooth random motion, and the motion fitted to its joints."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 2, frames)[:, None, None]
    vectors = 0.4 * rng.normal(size=(1, len(skeleton), 3)) * np.sin(time + rng.uniform(size=(1, 1, 3)))
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, -1, 3, 3)
    root = np.column_stack([np.sin(time[:, 0, 0]), 1 + 0 * time[:, 0, 0], time[:, 0, 0]])
    joints, _ = forward_kinematics(local, root, skeleton.offsets, skeleton.parents)
    return joints, fit_rigid(joints, skeleton, rotations=local)


def to_y_up(points: Floats) -> Floats:
    """(x, y, z) with Z up -> (x, z, -y)."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def body_joints(arrays: dict[str, NDArray], body: BodyModel) -> Floats:
    poses = arrays["poses"].astype(np.float64).reshape(len(arrays["poses"]), 55, 3)
    chosen = [*range(22), *range(25, 55)][: len(body.skeleton)]
    return to_y_up(smpl_joints(poses[:, chosen], arrays["trans"].astype(np.float64), body))


@pytest.mark.parametrize("name", ["smpl22", "smplx52"])
def test_the_neutral_body_wears_a_motion_of_its_own_bones_exactly(name: str, tmp_path: Path) -> None:
    joints, motion = posed(Skeleton.named(name))
    error = write_smplx(tmp_path / "x.npz", motion, 30.0)
    assert error.max_mm < 1e-3
    with np.load(tmp_path / "x.npz", allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    assert arrays["poses"].shape == (12, 165)
    assert float(arrays["mocap_frame_rate"]) == 30
    assert float(arrays["mocap_time_length"]) == pytest.approx(0.4)
    assert (arrays["betas"] == 0).all() and str(arrays["gender"]) == "neutral"
    np.testing.assert_array_equal(arrays["pose_hand"], arrays["poses"][:, 75:])
    np.testing.assert_array_equal(arrays["pose_body"], arrays["poses"][:, 3:66])
    np.testing.assert_array_equal(arrays["root_orient"], arrays["poses"][:, :3])
    shown = body_joints(arrays, BodyModel.neutral(name))  # type: ignore[arg-type]
    np.testing.assert_allclose(shown, joints, atol=1e-5)


def test_a_body_of_other_bones_stands_where_its_model_puts_it() -> None:
    """A made-up model: other lengths, and a pelvis below the origin, as SMPL-X has it."""
    skeleton = Skeleton.named("smplx52")
    _, motion = posed(skeleton, seed=1)
    rng = np.random.default_rng(2)
    other = with_offsets(skeleton, skeleton.offsets * rng.uniform(0.9, 1.1, size=(52, 1)))
    pelvis = np.array([0.003, -0.35, 0.012])
    body = BodyModel(other, other.rest_joints + pelvis, np.zeros((52, 3, 0)), {})
    arrays, error = smplx_parameters(motion, 20.0, body)
    assert error.max_mm < 5
    shown = body_joints(arrays, body)
    leg = [skeleton.index("right_knee"), skeleton.index("right_ankle")]
    sizes = [np.linalg.norm(s.offsets[leg], axis=-1).sum() for s in (other, skeleton)]
    np.testing.assert_allclose(shown[:, 0], motion.root * sizes[0] / sizes[1], atol=5e-3)
    # Every bone points the way it does in the motion.
    parents = list(skeleton.parents[1:])
    ways = [j[:, 1:] - j[:, parents] for j in (shown, motion.joints)]
    units = [w / np.linalg.norm(w, axis=-1, keepdims=True) for w in ways]
    assert np.einsum("tji,tji->tj", *units).min() > 0.97


def test_strange_skeletons_and_too_small_models_are_refused() -> None:
    odd = Skeleton("odd", ("a", "b"), (-1, 0), ((0, 0, 0), (0, 1, 0)))
    still = np.broadcast_to(np.eye(3), (2, 2, 3, 3)).copy()
    motion = RigidMotion.posed(odd, still, np.zeros((2, 3)), np.zeros((2, 2, 3)))
    with pytest.raises(UserError, match="smpl22 and smplx52"):
        smplx_parameters(motion, 20.0)
    _, whole = posed(Skeleton.named("smplx52"))
    with pytest.raises(UserError, match="use SMPL-X"):
        smplx_parameters(whole, 20.0, BodyModel.neutral("smpl22"))
