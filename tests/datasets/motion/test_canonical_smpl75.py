"""SMPL parameters moved to the canonical place still pose the same body."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.convert.common.smpl75 import canonical_smpl75
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.skeleton import Skeleton

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


def posed(columns: np.ndarray, body: BodyModel) -> np.ndarray:
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
    assert np.abs(posed(columns, body) - wanted).max() < 2e-6
    assert np.linalg.norm(columns[:, 3:].reshape(-1, 24, 3), axis=-1).max() <= np.pi + 1e-6
    hands = columns[:, 3 + 66 :].reshape(-1, 2, 3)
    assert np.abs(hands - poses[::step, 22:]).max() < 1e-6


def test_frames_between_source_frames_keep_the_bones() -> None:
    poses, trans = dance()
    columns = canonical_smpl75(poses, trans, NEUTRAL, 60.0, 25.0)
    assert len(columns) == 51
    joints = posed(columns, NEUTRAL)
    bones = np.linalg.norm(joints[:, 1:] - joints[:, list(NEUTRAL.skeleton.parents[1:])], axis=-1)
    assert np.abs(bones - np.linalg.norm(NEUTRAL.skeleton.offsets[1:], axis=-1)).max() < 1e-6
    # Frame 5 k lies at 0.2 k s, which is frame 12 k of the source.
    whole = posed(canonical_smpl75(poses, trans, NEUTRAL, 60.0, 60.0), NEUTRAL)
    away = np.abs(joints[::5] - whole[::12])
    assert np.ptp(joints[::5, 0, 1] - whole[::12, 0, 1]) < 1e-5  # the floor may differ by the lowest frame
    assert away[..., [0, 2]].max() < 1e-5
