"""Rigid skeletons against recorded motion and scipy's slow solver; planted feet; SMPL-X files read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.body.feet import foot_contacts, plant_feet
from motionloom.datasets.motion.body.rigid import (
    RigidMotion,
    fit_rigid,
    measured_skeleton,
    share_twist,
    with_offsets,
)
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.body.smplx_file import smplx_parameters, write_smplx
from motionloom.datasets.motion.features.joints import joints_of, rotations_of
from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton

Floats = NDArray[np.float64]


def lengths(joints: Floats, skeleton: Skeleton) -> Floats:
    return np.linalg.norm(joints[:, 1:] - joints[:, list(skeleton.parents[1:])], axis=-1)


def moving(skeleton: Skeleton, frames: int, seed: int, size: float = 0.5) -> tuple[Floats, Floats, Floats]:
    """A smooth random motion: local rotations, root, joints."""
    rng = np.random.default_rng(seed)
    wave = rng.normal(size=(2, 1, len(skeleton), 3)) * size
    time = np.linspace(0, 3, frames)[:, None, None]
    vectors = wave[0] * np.sin(time) + wave[1] * np.cos(2 * time)
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, -1, 3, 3)
    root = np.stack([np.sin(time[:, 0, 0]), 1 + 0 * time[:, 0, 0], time[:, 0, 0]], -1)
    return local, root, forward_kinematics(local, root, skeleton.offsets, skeleton.parents)[0]


def stretched(joints: Floats, skeleton: Skeleton, seed: int, amount: float = 0.25) -> Floats:
    """The same directions with bones that change their length from frame to frame."""
    rng = np.random.default_rng(seed)
    out = joints.copy()
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        factor = 1 + amount * rng.uniform(-1, 1, size=(len(joints), 1))
        out[:, joint] = out[:, parent] + factor * (joints[:, joint] - joints[:, parent])
    return out


@pytest.mark.parametrize("name", ["smpl22", "smplx52"])
def test_a_posed_skeleton_of_other_proportions_is_found_again(name: str) -> None:
    """Bones of other lengths, and a pelvis, chest and palms of another shape."""
    skeleton = Skeleton.named(name)
    rng = np.random.default_rng(1)
    bones = skeleton.offsets * rng.uniform(0.8, 1.25, size=(len(skeleton), 1))
    local, root, _ = moving(skeleton, 40, seed=2)
    joints, _ = forward_kinematics(local, root, bones, skeleton.parents)
    fitted = fit_rigid(joints, skeleton)
    assert fitted.error.max_mm < 1e-2
    found = np.linalg.norm(fitted.skeleton.offsets, axis=-1)
    np.testing.assert_allclose(found, np.linalg.norm(bones, axis=-1), atol=1e-9)


def test_bones_of_stretched_figures_keep_one_length_and_directions_stay() -> None:
    skeleton = Skeleton.named("smplx52")
    _, _, clean = moving(skeleton, 60, seed=3)
    joints = stretched(clean, skeleton, seed=4)
    assert np.ptp(lengths(joints, skeleton), axis=0).max() > 0.1
    fitted = fit_rigid(joints, skeleton)
    assert np.ptp(lengths(fitted.joints, skeleton), axis=0).max() < 1e-10
    turned = fitted.rotations @ fitted.rotations.swapaxes(-1, -2)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-10)
    again, _ = forward_kinematics(
        fitted.rotations, fitted.root, fitted.skeleton.offsets, fitted.skeleton.parents
    )
    np.testing.assert_allclose(again, fitted.joints, atol=1e-12)
    # Down the chain errors of lengths add up; the solver spreads them, so the fit is nearer everywhere.
    own = skeleton.with_lengths_of(joints)
    plain = joints_to_rotations(joints, own)
    chained, _ = forward_kinematics(plain, joints[:, 0], own.offsets, own.parents)
    assert fitted.error.mean_mm < 0.6 * np.linalg.norm(chained - joints, axis=-1).mean() * 1000


def test_the_solver_finds_what_scipy_finds_frame_by_frame() -> None:
    """An independent, slow reference: all local rotation vectors and the root, `least_squares` in float64."""
    skeleton = Skeleton.named("smpl22")
    _, _, clean = moving(skeleton, 2, seed=5, size=0.4)
    joints = stretched(clean, skeleton, seed=6, amount=0.15)
    own = measured_skeleton(joints, skeleton)
    start = joints_to_rotations(joints, own)
    turned, root = solve_poses(joints, own.offsets, own.parents, start, joints[:, 0])
    posed, _ = forward_kinematics(turned, root, own.offsets, own.parents)
    for frame in range(2):

        def residual(values: Floats, frame: int = frame) -> Floats:
            local = Rotation.from_rotvec(values[3:].reshape(-1, 3)).as_matrix()
            shown, _ = forward_kinematics(local, values[:3], own.offsets, own.parents)
            return (shown - joints[frame]).ravel()

        first = np.concatenate([joints[frame, 0], Rotation.from_matrix(start[frame]).as_rotvec().ravel()])
        reference = least_squares(residual, first, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        cost = float(np.square(posed[frame] - joints[frame]).sum() / 2)
        assert cost <= reference.cost * (1 + 1e-4)
        np.testing.assert_allclose((posed[frame] - joints[frame]).ravel(), reference.fun, atol=5e-4)


def test_known_rotations_keep_their_twist() -> None:
    layout = MotionLayout.named("smpl75")
    rng = np.random.default_rng(8)
    features = 0.3 * rng.normal(size=(5, layout.dim))
    rotations = rotations_of(features, layout)
    assert rotations is not None
    expected = Rotation.from_rotvec(features[:, 3:69].reshape(-1, 3)).as_matrix().reshape(5, 22, 3, 3)
    np.testing.assert_allclose(rotations, expected, atol=1e-12)
    fitted = fit_rigid(joints_of(features, layout), layout.skeleton, rotations=rotations)
    assert fitted.error.max_mm < 1e-6
    np.testing.assert_allclose(fitted.rotations, expected, atol=1e-6)
    assert rotations_of(np.zeros((5, 133)), MotionLayout.named("body133")) is None


def test_forearms_take_half_of_their_hands_twist_and_no_joint_moves() -> None:
    skeleton = Skeleton.named("smplx52")
    local = np.broadcast_to(np.eye(3), (30, len(skeleton), 3, 3)).copy()
    elbow, wrist = skeleton.index("left_elbow"), skeleton.index("left_wrist")
    axis = skeleton.offsets[wrist] / np.linalg.norm(skeleton.offsets[wrist])
    turn = np.linspace(0, 3.6, 30)  # beyond half a turn: the share must not jump
    local[:, wrist] = Rotation.from_rotvec(turn[:, None] * axis).as_matrix()
    shared_out = share_twist(local, skeleton)
    half = Rotation.from_rotvec(turn[:, None] / 2 * axis).as_matrix()
    np.testing.assert_allclose(shared_out[:, elbow], half, atol=1e-9)
    np.testing.assert_allclose(shared_out[:, elbow] @ shared_out[:, wrist], local[:, wrist], atol=1e-9)
    root = np.zeros((30, 3))
    before, _ = forward_kinematics(local, root, skeleton.offsets, skeleton.parents)
    after, _ = forward_kinematics(shared_out, root, skeleton.offsets, skeleton.parents)
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_motions_skeletons_and_models_that_do_not_fit_are_refused() -> None:
    skeleton = Skeleton.named("smpl22")
    with pytest.raises(UserError, match=r"\[T, 22, 3\]"):
        fit_rigid(np.zeros((4, 21, 3)), skeleton)
    with pytest.raises(UserError, match="NaN"):
        fit_rigid(np.full((4, 22, 3), np.nan), skeleton)
    with pytest.raises(UserError, match=r"\[4, 21, 3, 3\]"):
        fit_rigid(np.zeros((4, 22, 3)), skeleton, rotations=np.zeros((4, 21, 3, 3)))
    odd = Skeleton("odd", ("a", "b"), (-1, 0), ((0, 0, 0), (0, 1, 0)))
    still = np.broadcast_to(np.eye(3), (2, 2, 3, 3)).copy()
    motion = RigidMotion.posed(odd, still, np.zeros((2, 3)), np.zeros((2, 2, 3)))
    with pytest.raises(UserError, match="skeleton"):
        smplx_parameters(motion, 20.0)
    _, whole = posed(Skeleton.named("smplx52"))
    with pytest.raises(UserError, match="use SMPL-X"):
        smplx_parameters(whole, 20.0, BodyModel.neutral("smpl22"))


def test_joints_without_bones_and_single_frames_are_fitted() -> None:
    skeleton = Skeleton.named("smplx52")
    _, _, joints = moving(skeleton, 1, seed=11)
    assert fit_rigid(joints, skeleton).error.max_mm < 1e-3
    joints[:, 22:37] = joints[:, 20:21]  # a left hand without fingers
    fitted = fit_rigid(joints, skeleton)
    assert fitted.error.max_mm < 1e-3
    assert np.isfinite(fitted.rotations).all()


FPS = 20.0
SKELETON = Skeleton.named("smpl22")
BALLS = [SKELETON.index("left_foot"), SKELETON.index("right_foot")]


def standing_and_sliding(frames: int = 60, slide: float = 0.2) -> NDArray[np.float64]:
    """The rest pose on the floor with bent knees, in the air from frame 20 to 40, and it drifts ahead."""
    joints = np.repeat(SKELETON.rest_joints[None], frames, axis=0)
    joints[..., 1] -= joints[..., 1].min()
    for side in ("left", "right"):
        knee = SKELETON.index(f"{side}_knee")
        joints[:, knee, 2] += 0.08
    time = np.arange(frames) / FPS
    joints[..., 2] += slide * time[:, None]
    joints[20:40, :, 1] += 0.3 * np.sin(np.linspace(0, np.pi, 20))[:, None] + 0.06
    return joints


def test_feet_stand_where_they_are_low_and_slow_and_without_contacts_nothing_changes() -> None:
    contacts = foot_contacts(standing_and_sliding(), SKELETON, FPS)
    expected = np.ones((60, 2), bool)
    expected[20:40] = False
    np.testing.assert_array_equal(contacts, expected)
    assert not foot_contacts(standing_and_sliding(slide=2.0), SKELETON, FPS).any()
    fitted: RigidMotion = fit_rigid(standing_and_sliding(slide=2.0), SKELETON)
    none = np.zeros((60, 2), bool)
    same, _ = plant_feet(fitted, fitted.joints, none, FPS)
    assert same is fitted
    sunk = fitted.joints.copy()
    sunk[10:20, [7, 10], 1] -= 0.05
    figure = fit_rigid(sunk, SKELETON)
    assert (
        figure.joints[..., 1].min()
        < -0.03
        < -0.01
        < plant_feet(figure, sunk, none, FPS)[0].joints[..., 1].min()
    )


def test_contact_columns_take_the_place_of_speed_and_short_contacts_are_none() -> None:
    layout = MotionLayout.named("h3d263")
    features = np.zeros((60, layout.dim))
    columns = features[:, layout.slice("foot_contacts")]
    columns[:20, 1] = 1  # ball of the left foot
    columns[41, 3] = 1  # one frame of the right one
    columns[50:, 3] = 1
    columns[54, 3] = 0  # a gap of one frame
    features[:, layout.slice("foot_contacts")] = columns
    contacts = foot_contacts(standing_and_sliding(slide=2.0), SKELETON, FPS, features, layout)
    expected = np.zeros((60, 2), bool)
    expected[:20, 0] = expected[50:, 1] = True
    np.testing.assert_array_equal(contacts, expected)


def test_planted_feet_stay_where_they_stand_and_the_report_says_so() -> None:
    joints = standing_and_sliding()
    fitted = fit_rigid(joints, SKELETON)
    contacts = foot_contacts(fitted.joints, SKELETON, FPS)
    planted, report = plant_feet(fitted, joints, contacts, FPS)
    for run in (slice(0, 20), slice(40, 60)):
        spread = np.ptp(planted.joints[run][:, BALLS][..., [0, 2]], axis=0)
        assert spread.max() < 2e-3
    assert report.slide_before == pytest.approx(20.0, abs=0.5)
    assert report.slide_after < 0.5
    assert planted.error.mean_mm > fitted.error.mean_mm == report.unplanted.mean_mm
    # Bones stay what they were, and the jump between the contacts has no step in it.
    parents = list(SKELETON.parents[1:])
    sizes = np.linalg.norm(planted.joints[:, 1:] - planted.joints[:, parents], axis=-1)
    assert np.ptp(sizes, axis=0).max() < 1e-9
    moved = np.abs(np.diff(planted.joints - fitted.joints, axis=0)).max()
    # 10 cm of correction fade over 3 frames, by at most 1.5 times the even share.
    assert moved < 1.5 * 0.1 / 3


def posed(skeleton: Skeleton, frames: int = 12, seed: int = 0) -> tuple[Floats, RigidMotion]:
    """Local rotations of a smooth random motion, and the motion fitted to its joints."""
    local, _, joints = moving(skeleton, frames, seed, size=0.3)
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
    assert error.mean_mm < 2  # legs of two lengths cannot both be as high as they were
    shown = body_joints(arrays, body)
    feet = [skeleton.index(f"{side}_{name}") for side in ("left", "right") for name in ("ankle", "foot")]
    sizes = [s.rest_joints[feet, 1].mean() for s in (other, skeleton)]
    np.testing.assert_allclose(shown[:, 0], motion.root * sizes[0] / sizes[1], atol=0.03)
    # Every bone points the way it does in the motion.
    parents = list(skeleton.parents[1:])
    ways = [j[:, 1:] - j[:, parents] for j in (shown, motion.joints)]
    units = [w / np.linalg.norm(w, axis=-1, keepdims=True) for w in ways]
    assert np.einsum("tji,tji->tj", *units).min() > 0.97
