"""Forward kinematics against a slow loop, rotations from joints, and figures judged: people or not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations, swing
from motionloom.datasets.motion.plausibility import FigureMeasure, PlausibilityStats, measure
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
def test_the_rest_pose_is_no_rotation_and_degenerate_figures_give_no_nan(name: str) -> None:
    skeleton = Skeleton.named(name)
    still = np.broadcast_to(np.eye(3), (len(skeleton), 3, 3))
    np.testing.assert_allclose(joints_to_rotations(skeleton.rest_joints, skeleton), still, atol=1e-9)
    np.testing.assert_allclose(joints_to_rotations(np.zeros((len(skeleton), 3)), skeleton), still, atol=1e-9)
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


SKELETON = Skeleton.named("smpl22")
FPS = 10.0
Floats = np.ndarray


def person(
    seed: int = 0, frames: int = 60, speed: float = 1.0, **turns: tuple[float, float, float]
) -> Floats:
    """Joints [T, 22, 3] of somebody who sways and goes forward; `turns` are axis-angles of single joints."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames)[:, None, None] / FPS
    vectors = 0.25 * rng.standard_normal((1, 22, 3)) * np.sin(times * rng.uniform(1, 4, (1, 22, 1)))
    vectors[:, 0] *= 0.2
    for joint, vector in turns.items():
        vectors[:, SKELETON.index(joint)] += vector
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 22, 3, 3)
    root = np.stack([0 * times[:, 0, 0], 0 * times[:, 0, 0] + 0.95, speed * times[:, 0, 0]], axis=-1)
    joints, _ = forward_kinematics(rotations, root, SKELETON.offsets, SKELETON.parents)
    return np.asarray(joints, dtype=np.float64)


def squat(seed: int) -> Floats:
    return person(seed, speed=0.0, left_hip=(-1.8, 0, 0), right_hip=(-1.8, 0, 0), left_knee=(2.2, 0, 0),
                  right_knee=(2.2, 0, 0), pelvis=(0.6, 0, 0))  # fmt: skip


def jump(seed: int) -> Floats:
    joints = person(seed, speed=0.0)
    joints[..., 1] += np.maximum(0, np.sin(np.arange(60) / 3))[:, None] * 0.6
    return joints


def stats_of(clips: list[Floats]) -> PlausibilityStats:
    stats = PlausibilityStats()
    for clip in clips:
        stats.add(measure(clip, FPS))
    return stats


def kinds(clips: list[Floats], **options: bool) -> list[tuple[str, bool]]:
    return [(oddity.kind, oddity.is_error) for oddity in stats_of(clips).oddities(**options)]  # type: ignore[arg-type]


PEOPLE = [person(seed) for seed in range(6)]


def lying(joints: Floats) -> Floats:
    """As a file reads whose z axis points up after all."""
    return np.stack([joints[..., 0], joints[..., 2], -joints[..., 1]], axis=-1)


def collapsed(joints: Floats) -> Floats:
    """Thighs of hardly any length, as of position channels that are half filled; no unit mends that."""
    shift = 0.95 * (joints[:, [1, 2]] - joints[:, [4, 5]])
    for first, move in zip((4, 5), shift.swapaxes(0, 1), strict=True):
        joints[:, first::3][:, :3] += move[:, None]
    return joints * 1.3


def mirrored(joints: Floats) -> Floats:
    return joints[:, list(SKELETON.mirror)]


def test_a_clip_is_measured_as_it_was_made() -> None:
    clip = measure(person(0, speed=1.2), FPS)
    rest = np.broadcast_to(SKELETON.rest_joints, (5, 22, 3))
    assert measure(rest, FPS).height == pytest.approx(1.7, abs=1e-9)
    assert clip.height == pytest.approx(1.7, abs=0.05)
    assert clip.up[1] > 0.95 and clip.above_floor < 0.1
    assert clip.toes > 0.8
    twice = measure(person(0) * 2 + [5.0, 3.0, -1.0], FPS)
    assert twice.height == pytest.approx(2 * measure(person(0), FPS).height)
    assert twice.floor == pytest.approx(measure(person(0), FPS).floor * 2 + 3.0)
    assert measure(person(0)[:1], FPS).height == pytest.approx(1.7, abs=0.05)


@pytest.mark.parametrize("pose", [person, squat, jump], ids=["walking", "squatting", "jumping"])
def test_people_are_people(pose: Callable[[int], Floats]) -> None:
    assert kinds([pose(seed) for seed in range(6)], floor_at_zero=False) == []


def test_a_few_who_lie_are_no_error_and_many_are() -> None:
    assert kinds([*PEOPLE[:5], lying(PEOPLE[5])]) == []
    assert kinds([*PEOPLE[:4], *map(lying, PEOPLE[4:])]) == [("lying", False)]
    assert kinds([*PEOPLE[:2], *map(lying, PEOPLE[2:])]) == [("lying", True)]
    (oddity,) = stats_of([lying(clip) for clip in PEOPLE]).oddities()
    assert str(oddity.text).startswith("6 of 6 clips")


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda joints: joints * 100, "size"),
        (lambda joints: joints / 2.54, "size"),
        (lying, "lying"),
        (lambda joints: joints * [1, -1, -1], "upside down"),
        (lambda joints: collapsed(joints.copy()), "limbs"),
        (mirrored, "left and right"),
    ],
)
def test_wrong_figures_are_errors(change: Callable[[Floats], Floats], kind: str) -> None:
    found = [name for name, error in kinds([change(clip) for clip in PEOPLE]) if error]
    assert kind in found


def test_floating_and_sinking_are_against_the_floor() -> None:
    canonical = [clip - [0, clip[..., 1].min(), 0] for clip in PEOPLE]
    assert kinds(canonical, floor_at_zero=True) == []
    high, low = ([clip + np.array([0, y, 0]) for clip in canonical] for y in (0.5, -0.5))
    assert kinds(high, floor_at_zero=True) == [("floating", True)]
    assert kinds(low, floor_at_zero=True) == [("below the floor", True)]
    assert kinds(high) == [] and kinds(low) == []  # raw files stand anywhere
    rising = [clip + np.linspace(0, 4, len(clip))[:, None, None] * [0, 1, 0] for clip in canonical]
    assert kinds(rising) == [("floating", True)]


def test_nothing_is_said_about_nobody() -> None:
    stats = PlausibilityStats()
    assert stats.oddities() == [] and len(stats) == 0 and np.isnan(stats.height)
    stats.add(FigureMeasure(float("nan"), (0.0, 1.0, 0.0), 0.0, 0.0, 1.0))
    assert [oddity.kind for oddity in stats.oddities()] == ["size"]
