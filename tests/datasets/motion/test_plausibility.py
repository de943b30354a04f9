"""Figures measured and judged: people in any pose pass; wrong sizes, axes, floors and sides do not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.plausibility import FigureMeasure, PlausibilityStats, measure
from motionloom.datasets.motion.skeleton import Skeleton

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


def mirrored(joints: Floats) -> Floats:
    return joints[:, list(SKELETON.mirror)]


def test_a_clip_is_measured_as_it_was_made() -> None:
    clip = measure(person(0, speed=1.2), FPS)
    rest = np.broadcast_to(SKELETON.rest_joints, (5, 22, 3))
    assert measure(rest, FPS).height == pytest.approx(1.7, abs=1e-9)
    assert clip.height == pytest.approx(1.7, abs=0.05)
    assert clip.up[1] > 0.95 and clip.above_floor < 0.1
    assert clip.forward is not None and clip.forward > 0.9 and clip.toes > 0.8
    assert measure(person(0, speed=-1.2), FPS).forward == pytest.approx(-clip.forward, abs=0.1)
    assert measure(person(0, speed=0.0), FPS).forward is None
    twice = measure(person(0) * 2 + [5.0, 3.0, -1.0], FPS)
    assert twice.height == pytest.approx(2 * measure(person(0), FPS).height)
    assert twice.floor == pytest.approx(measure(person(0), FPS).floor * 2 + 3.0)
    one = measure(person(0)[:1], FPS)
    assert one.height == pytest.approx(1.7, abs=0.05) and one.forward is None


def test_the_height_is_the_same_in_any_pose_and_in_noise() -> None:
    for pose in (squat(1), jump(2), lying(person(3))):
        assert measure(pose, FPS).height == pytest.approx(1.7, abs=0.05)
    noise = 0.05 * np.random.default_rng(0).standard_normal((60, 22, 3))
    assert measure(person(4) + noise, FPS).height == pytest.approx(1.75, abs=0.07)


@pytest.mark.parametrize("pose", [person, squat, jump], ids=["walking", "squatting", "jumping"])
def test_people_are_people(pose: Callable[[int], Floats]) -> None:
    assert kinds([pose(seed) for seed in range(6)], floor_at_zero=False) == []


def test_a_few_who_lie_are_no_error_and_many_are() -> None:
    assert kinds([*PEOPLE[:5], lying(PEOPLE[5])]) == []
    assert kinds([*PEOPLE[:4], *map(lying, PEOPLE[4:])]) == [("lying", False)]
    assert kinds([*PEOPLE[:2], *map(lying, PEOPLE[2:])]) == [("lying", True)]


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda joints: joints * 100, "size"),
        (lambda joints: joints / 2.54, "size"),
        (lying, "lying"),
        (lambda joints: joints * [1, -1, -1], "upside down"),
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


def test_walking_backwards_is_odd_and_no_error() -> None:
    back = [person(seed, speed=-1.0) for seed in range(4)]
    assert kinds(back) == [("backwards", False)]
    assert kinds([*back[:2], *PEOPLE]) == []
    (oddity,) = stats_of(back).oddities()
    assert str(oddity.text).startswith("4 of 4 clips (100%)")


def test_nothing_is_said_about_nobody() -> None:
    stats = PlausibilityStats()
    assert stats.oddities() == [] and len(stats) == 0 and np.isnan(stats.height)
    stats.add(FigureMeasure(float("nan"), (0.0, 1.0, 0.0), 0.0, 0.0, None, 1.0))
    assert [oddity.kind for oddity in stats.oddities()] == ["size"]
