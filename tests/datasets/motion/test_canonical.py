"""Heading, canonical pose, mirroring, resampling and retargeting; SMPL parameters; hands at rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.common.features import canonical_smpl75
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import (
    canonicalize,
    facing,
    heading,
    mirror,
    resample,
    resample_quaternions,
    retarget,
)
from motionloom.datasets.motion.features.smpl75 import fit_smpl75, joints24_of
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton

FPS = 20.0
BODY = Skeleton.named("smpl22")


def turn(joints: NDArray, angle: float) -> NDArray:
    """Points turned left about the Y axis."""
    return joints @ Rotation.from_rotvec([0, angle, 0]).as_matrix().T


def walk(turned: float, seconds: float = 5.0, fps: float = FPS, skeleton: Skeleton = BODY) -> NDArray:
    """A figure [T, N, 3] that walks at 1 m/s with swinging legs and turns left by `turned` radians in all."""
    frames = int(seconds * fps) + 1
    time = np.arange(frames) / fps
    angle = turned * time / seconds
    local = np.tile(np.eye(3), (frames, len(skeleton), 1, 1))
    local[:, 0] = Rotation.from_rotvec(angle[:, None] * [0, 1, 0]).as_matrix()
    swing = 0.5 * np.sin(2 * np.pi * time)[:, None]
    local[:, skeleton.index("left_hip")] = Rotation.from_rotvec(swing * [1, 0, 0]).as_matrix()
    local[:, skeleton.index("right_hip")] = Rotation.from_rotvec(-swing * [1, 0, 0]).as_matrix()
    step = np.exp(1j * angle) / fps
    path = np.concatenate([[0], np.cumsum(step[:-1])])
    root = np.stack([path.imag, np.full(frames, 0.95), path.real], axis=-1)
    return forward_kinematics(local, root, skeleton.offsets, skeleton.parents)[0]


def test_a_left_turn_makes_the_heading_grow_and_its_mirror_image_turns_right() -> None:
    joints = walk(np.pi / 2)
    angle = heading(joints, FPS)
    assert BODY.rest_joints[BODY.index("left_hip"), 0] > 0
    assert np.all(np.diff(angle) > 0)
    assert angle[0] == pytest.approx(0.0, abs=1e-9)
    assert angle[-1] == pytest.approx(np.pi / 2, abs=1e-9)
    assert joints[-1, 0, 0] > 2.0, "the path must bend towards +X"
    joints = walk(2.0)
    mirrored = mirror(joints, BODY)
    np.testing.assert_allclose(heading(mirrored, FPS), -heading(joints, FPS), atol=1e-9)
    assert np.all(np.diff(heading(mirrored, FPS)) < 0)
    assert mirrored[-1, 0, 0] < -2.0
    left, right = BODY.index("left_foot"), BODY.index("right_foot")
    np.testing.assert_allclose(mirrored[:, left], joints[:, right] * [-1, 1, 1])


@given(st.integers(2, 60), st.integers(0, 2**31 - 1))
@settings(max_examples=25, deadline=None)
def test_heading_equals_a_slow_gaussian_over_the_point_reflected_angle(frames: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    raw = np.cumsum(rng.uniform(-0.5, 0.5, size=frames))
    joints = np.stack([turn(BODY.rest_joints, angle) for angle in raw])
    fps = 10.0
    reach = int(4 * fps + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / fps) ** 2)
    weights /= weights.sum()

    def reflected(index: int) -> float:
        if index < 0:
            return 2 * raw[0] - reflected(-index)
        if index >= frames:
            return 2 * raw[-1] - reflected(2 * (frames - 1) - index)
        return float(raw[index])

    slow = [sum(w * reflected(t + k - reach) for k, w in enumerate(weights)) for t in range(frames)]
    fast = heading(joints, fps)
    np.testing.assert_allclose(fast - fast[0], np.asarray(slow) - slow[0], atol=1e-9)
    assert fast[0] == pytest.approx(facing(joints)[0], abs=1e-12)


def test_frames_that_face_nowhere_keep_the_last_heading() -> None:
    joints = walk(0.6)
    angle = facing(joints)
    joints[30:40] = joints[30:40, :1]
    held = facing(joints)
    np.testing.assert_allclose(held[30:40], angle[29])
    np.testing.assert_allclose(held[40:], angle[40:])
    joints[:5] = joints[:5, :1]
    np.testing.assert_allclose(facing(joints)[:5], angle[5])
    np.testing.assert_array_equal(facing(np.zeros((3, 22, 3))), 0.0)


@given(st.floats(-9, 9), st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 2))
@settings(max_examples=25, deadline=None)
def test_canonical_joints_do_not_depend_on_place_or_first_heading(
    angle: float, x: float, z: float, height: float
) -> None:
    joints = canonicalize(walk(1.0))
    np.testing.assert_allclose(
        canonicalize(turn(joints, angle) + np.array([x, height, z])), joints, atol=1e-9
    )
    assert joints[..., 1].min() == 0.0 and canonicalize(joints.astype(np.float32)).dtype == np.float32
    np.testing.assert_allclose(joints[0, 0, [0, 2]], 0.0, atol=1e-12)
    assert facing(joints)[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("fps_in", "fps_out"), [(60, 20), (30, 20), (20, 30), (24, 20), (29.97, 20)])
def test_resampling_a_straight_line_in_time_keeps_the_line(fps_in: float, fps_out: float) -> None:
    values = np.arange(61)[:, None] / fps_in * [[1.0, -2.0]]
    out = resample(values, fps_in, fps_out)
    assert len(out) == int(60 * fps_out / fps_in + 1e-9) + 1
    np.testing.assert_allclose(out, np.arange(len(out))[:, None] / fps_out * [[1.0, -2.0]], atol=1e-9)


def test_resampling_takes_input_frames_where_they_fall_on_output_frames() -> None:
    joints = np.random.default_rng(0).normal(size=(31, 22, 3)).astype(np.float32)
    np.testing.assert_array_equal(resample(joints, 60, 20), joints[::3])
    np.testing.assert_array_equal(resample(joints, 30, 30), joints)
    np.testing.assert_array_equal(resample(joints[:1], 30, 20), joints[:1])
    assert resample(joints, 30, 20).dtype == np.float32
    with pytest.raises(UserError, match="not 0 and 20"):
        resample(joints, 0, 20)
    with pytest.raises(UserError, match="frames"):
        resample(joints[:0], 30, 20)
    with pytest.raises(UserError, match="is the frame rate right"):
        resample(np.zeros((300, 22, 3)), 1 / 59, 20)


def test_quaternion_resampling_equals_scipys_slerp_whatever_the_signs() -> None:
    rng = np.random.default_rng(1)
    steps = Rotation.from_rotvec(rng.normal(scale=0.3, size=(16, 3)))
    pose = Rotation.identity()
    keys = []
    for step in steps:
        pose = pose * step
        keys.append(pose.as_quat())
    quaternions = np.array(keys) * rng.choice([-1, 1], size=(16, 1))
    out = resample_quaternions(quaternions[:, None], 30, 20)[:, 0]
    want = Slerp(np.arange(16) / 30, Rotation.from_quat(quaternions))(np.arange(len(out)) / 20)
    assert (Rotation.from_quat(out) * want.inv()).magnitude().max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(out, axis=-1), 1.0, atol=1e-12)


def test_retargeting_gives_the_wanted_bones_and_keeps_directions() -> None:
    joints = walk(1.0)
    scale = np.random.default_rng(2).uniform(0.7, 1.4, size=(22, 1))
    offsets = BODY.offsets * scale
    out = retarget(joints, BODY, offsets)
    parents = list(BODY.parents[1:])
    before, after = joints[:, 1:] - joints[:, parents], out[:, 1:] - out[:, parents]
    lengths = np.linalg.norm(offsets[1:], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(after, axis=-1), np.tile(lengths, (len(out), 1)), atol=1e-9)
    np.testing.assert_allclose(np.cross(before, after), 0.0, atol=1e-9)
    legs = [np.linalg.norm(o[[5, 8]], axis=-1).sum() for o in (BODY.offsets, offsets)]
    np.testing.assert_allclose(out[:, 0], joints[:, 0] * legs[1] / legs[0], atol=1e-9)
    np.testing.assert_allclose(retarget(joints, BODY), joints, atol=1e-9)
    batch = np.stack([joints, 1.3 * joints])
    np.testing.assert_allclose(retarget(batch, BODY), np.stack([joints, joints]), atol=1e-9)
    assert np.isfinite(retarget(np.zeros_like(joints), BODY)).all()
    with pytest.raises(UserError, match=r"\[\.\.\., 22, 3\]"):
        retarget(joints[:, :21], BODY)


NEUTRAL = BodyModel.neutral("smpl22")
MODEL = BodyModel(  # like a real model: the pelvis is not at the origin
    Skeleton.named("smpl22"), np.add(NEUTRAL.template, [0.01, -0.25, 0.03]), np.zeros((22, 3, 0)), {}
)


def dance(frames: int = 121) -> tuple[np.ndarray, np.ndarray]:
    """Smooth poses [T, 24, 3] of a figure that starts anywhere, and turns more than once; trans [T, 3]."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 2, frames)[:, None, None]
    poses = 0.4 * np.sin(t * rng.uniform(1, 3, (24, 3)) + rng.uniform(0, 6, (24, 3)))
    poses[:, 0] = [0.0, 1.0, 0.0]
    poses[:, 0] *= 1.2 + 4.0 * t[:, :, 0]
    trans = np.stack([t[:, 0, 0], 2 + 0.1 * np.sin(3 * t[:, 0, 0]), -3 + 0.5 * t[:, 0, 0]], axis=-1)
    return poses, trans


def joints_of_columns(columns: np.ndarray, body: BodyModel) -> np.ndarray:
    values = columns.astype(np.float64)
    return smpl_joints(values[:, 3:].reshape(-1, 24, 3)[:, :22], values[:, :3], body)


@pytest.mark.parametrize("body", [NEUTRAL, MODEL], ids=["neutral", "model"])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_stored_parameters_pose_the_canonical_joints(body: BodyModel, step: int) -> None:
    poses, trans = dance()
    columns = canonical_smpl75(poses, trans, body, 60.0, 60.0 / step)
    wanted = canonicalize(smpl_joints(poses[:, :22], trans, body)[::step])
    assert columns.dtype == np.float32
    assert columns.shape == (len(wanted), 75)
    assert np.abs(joints_of_columns(columns, body) - wanted).max() < 2e-6
    assert np.linalg.norm(columns[:, 3:].reshape(-1, 24, 3), axis=-1).max() <= np.pi + 1e-6
    hands = columns[:, 3 + 66 :].reshape(-1, 2, 3)
    assert np.abs(hands - poses[::step, 22:]).max() < 1e-6


@pytest.mark.parametrize("body", [NEUTRAL, MODEL], ids=["neutral", "model"])
def test_joints_alone_are_posed_by_the_neutral_body(body: BodyModel) -> None:
    """Its own motion to a millimetre; another body's as far as its proportions let, feet on the floor."""
    poses, trans = dance()
    joints = smpl_joints(poses[:, :22], trans, body)
    columns = fit_smpl75(joints)
    assert columns.shape == (len(joints), 75) and columns.dtype == np.float32
    assert not columns[:, 3 + 66 :].any(), "nothing is known of the hands"
    posed, wanted = joints_of_columns(columns, NEUTRAL), canonicalize(joints)
    assert np.linalg.norm(posed - wanted, axis=-1).mean() < (1e-3 if body is NEUTRAL else 0.1)
    assert abs(posed[..., 1].min()) < 1e-5


WHOLE = Skeleton.named("smplx52")


def test_hands_of_smpl_turn_with_the_wrist() -> None:
    columns = np.random.default_rng(0).normal(0, 0.5, (4, 75))
    made = joints24_of(columns)
    np.testing.assert_allclose(made[:, :22], joints_of_columns(columns, NEUTRAL), atol=1e-12)
    turned = columns.copy()
    turned[:, 3 + 3 * 20 : 3 + 3 * 22] += 0.7  # both wrists
    other = joints24_of(turned)
    np.testing.assert_allclose(other[:, :22], made[:, :22], atol=1e-12)
    for hand, wrist in ((22, 20), (23, 21)):
        lengths = np.linalg.norm(other[:, hand] - other[:, wrist], axis=-1)
        np.testing.assert_allclose(lengths, 0.0926, atol=1e-3)
        assert np.linalg.norm(other[:, hand] - made[:, hand], axis=-1).min() > 0.01


def posed(seed: int, size: float = 1.0) -> np.ndarray:
    """Joints [5, 22, 3] of a body of this size in random poses."""
    turns = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.4, (5 * 22, 3))).as_matrix()
    root = np.random.default_rng(seed).normal(0, 1, (5, 3))
    return forward_kinematics(turns.reshape(5, 22, 3, 3), root, BODY.offsets * size, BODY.parents)[0]


def test_hands_keep_their_bones_and_go_with_their_forearms() -> None:
    body = posed(3, size=1.25)
    made = with_resting_hands(body)
    np.testing.assert_array_equal(made[:, :22], body)
    parents = np.array(WHOLE.parents[22:])
    bones = np.linalg.norm(made[:, 22:] - made[:, parents], axis=-1)
    wanted = 1.25 * np.linalg.norm(WHOLE.offsets[22:], axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(wanted, bones.shape), rtol=1e-9)
    with pytest.raises(UserError, match=r"\[2, 52, 3\]"):
        with_resting_hands(np.zeros((2, 52, 3)))
    # A hand points on from the forearm, whatever the pose; the mirror image has the mirrored hands.
    for side in ("left", "right"):
        elbow, wrist, knuckle = (WHOLE.index(f"{side}_{name}") for name in ("elbow", "wrist", "middle1"))
        forearm, palm = made[:, wrist] - made[:, elbow], made[:, knuckle] - made[:, wrist]
        cosine = (forearm * palm).sum(-1) / np.linalg.norm(forearm, axis=-1) / np.linalg.norm(palm, axis=-1)
        assert cosine.min() > 0.9
    flip = np.array([-1.0, 1.0, 1.0])
    left, right = Rotation.random(2 * 15 * len(body), rng=3).as_matrix().reshape(2, -1, 15, 3, 3)
    for own, swapped in ((None, None), ((left, right), (right, left))):
        other = with_resting_hands(body[:, BODY.mirror] * flip, swapped)
        made = with_resting_hands(body, own)
        np.testing.assert_allclose(other, made[:, WHOLE.mirror] * flip, atol=1e-7)
