"""Planted feet: standing feet stay, swinging feet and everything above hardly change."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.feet import foot_contacts, plant_feet
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton

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


def test_feet_stand_where_they_are_low_and_slow() -> None:
    contacts = foot_contacts(standing_and_sliding(), SKELETON, FPS)
    expected = np.ones((60, 2), bool)
    expected[20:40] = False
    np.testing.assert_array_equal(contacts, expected)
    assert not foot_contacts(standing_and_sliding(slide=2.0), SKELETON, FPS).any()


def test_contact_columns_take_the_place_of_speed_and_short_contacts_are_none() -> None:
    layout = MotionLayout.named("h3d263")
    features = np.zeros((60, layout.dim))
    columns = features[:, layout.slice("foot_contacts")]
    columns[:20, 1] = 1  # ball of the left foot
    columns[41, 3] = 1  # one frame of the right one
    columns[50:, 3] = 1
    columns[54, 3] = 0  # a gap of one frame
    features[:, layout.slice("foot_contacts")] = columns
    contacts = foot_contacts(standing_and_sliding(slide=2.0), SKELETON, FPS, None, features, layout)
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
    assert report.contact == pytest.approx(2 / 3)
    assert planted.error.mean_mm > fitted.error.mean_mm == report.unplanted.mean_mm
    # Bones stay what they were, and the jump between the contacts has no step in it.
    parents = list(SKELETON.parents[1:])
    sizes = np.linalg.norm(planted.joints[:, 1:] - planted.joints[:, parents], axis=-1)
    assert np.ptp(sizes, axis=0).max() < 1e-9
    moved = np.abs(np.diff(planted.joints - fitted.joints, axis=0)).max()
    # 10 cm of correction fade over 3 frames, by at most 1.5 times the even share.
    assert moved < 1.5 * 0.1 / 3


def walking(frames: int = 80, sliding: float = 0.3) -> NDArray[np.float64]:
    """Legs that swing by sines while the root goes faster than they step: one foot is down at a time."""
    time = np.arange(frames) / FPS
    local = np.broadcast_to(np.eye(3), (frames, 22, 3, 3)).copy()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * np.sin(2 * np.pi * 0.9 * time)
        bend = 0.9 * np.clip(
            sign * np.cos(2 * np.pi * 0.9 * time), 0, 1
        )  # the knee bends while it swings ahead
        local[:, SKELETON.index(f"{side}_hip")] = Rotation.from_euler(
            "x", (-0.35 * swing - bend / 2)[:, None]
        ).as_matrix()
        local[:, SKELETON.index(f"{side}_knee")] = Rotation.from_euler("x", bend[:, None]).as_matrix()
    joints, _ = forward_kinematics(local, np.zeros((frames, 3)), SKELETON.offsets, SKELETON.parents)
    joints[..., 1] -= joints[:, BALLS, 1].min(axis=1)[:, None]
    # The root goes on by as much as the lower foot goes back, and slides on top of that.
    lower = joints[:, BALLS, 1].argmin(axis=1)
    back = -np.diff(joints[:, BALLS, 2], axis=0)[np.arange(frames - 1), lower[1:]]
    path = np.concatenate([[0], np.cumsum(back)]) + sliding * time
    joints[..., 2] += path[:, None]
    return joints


def test_a_walk_keeps_its_swing() -> None:
    joints = walking()
    fitted = fit_rigid(joints, SKELETON)
    contacts = foot_contacts(fitted.joints, SKELETON, FPS)
    assert 0.2 < contacts.mean() < 0.8
    planted, report = plant_feet(fitted, joints, contacts, FPS)
    assert report.slide_before > 15
    assert report.slide_after < 0.1 * report.slide_before
    away = np.linalg.norm(planted.joints - fitted.joints, axis=-1)
    assert away[:, SKELETON.index("head")].max() < 0.05
    # A foot in the air, farther from its contacts than the blend, goes where it went.
    near = np.zeros_like(contacts)
    for shift in range(-4, 5):
        near |= np.roll(contacts, shift, axis=0)
    for foot, ball in enumerate(BALLS):
        swinging = ~near[:, foot]
        assert away[swinging, ball].max(initial=0.0) < 2e-3


def test_without_contacts_nothing_changes() -> None:
    fitted: RigidMotion = fit_rigid(standing_and_sliding(slide=2.0), SKELETON)
    same, report = plant_feet(fitted, fitted.joints, np.zeros((60, 2), bool), FPS)
    assert same is fitted
    assert "no foot stands" in str(report)
