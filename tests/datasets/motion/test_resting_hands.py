"""Hands for a figure without fingers: relaxed, on its wrists, as large as its forearms say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.resting_hands import relaxed_fingers, with_resting_hands
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

WHOLE, BODY = Skeleton.named("smplx52"), Skeleton.named("smpl22")


def posed(seed: int, size: float = 1.0) -> np.ndarray:
    """Joints [5, 22, 3] of a body of this size in random poses."""
    turns = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.4, (5 * 22, 3))).as_matrix()
    root = np.random.default_rng(seed).normal(0, 1, (5, 3))
    return forward_kinematics(turns.reshape(5, 22, 3, 3), root, BODY.offsets * size, BODY.parents)[0]


def test_of_the_rest_pose_only_the_fingers_bend() -> None:
    made = with_resting_hands(BODY.rest_joints[None].repeat(2, 0))
    local = np.tile(np.eye(3), (52, 1, 1))
    mirror = np.diag([-1.0, 1.0, 1.0])
    local[22:37], local[37:] = relaxed_fingers(), mirror @ relaxed_fingers() @ mirror
    wanted, _ = forward_kinematics(local, np.zeros(3), WHOLE.offsets, WHOLE.parents)
    np.testing.assert_allclose(made, np.stack([wanted, wanted]), atol=1e-9)


def test_bones_keep_their_length_and_the_body_its_place() -> None:
    body = posed(3, size=1.25)
    made = with_resting_hands(body)
    np.testing.assert_array_equal(made[:, :22], body)
    parents = np.array(WHOLE.parents[22:])
    bones = np.linalg.norm(made[:, 22:] - made[:, parents], axis=-1)
    wanted = 1.25 * np.linalg.norm(WHOLE.offsets[22:], axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(wanted, bones.shape), rtol=1e-9)


def test_a_hand_goes_with_its_forearm() -> None:
    """A hand points on from the forearm, whatever the pose; the mirror image has the mirrored hands."""
    body = posed(4)
    made = with_resting_hands(body)
    for side in ("left", "right"):
        elbow, wrist, knuckle = (WHOLE.index(f"{side}_{name}") for name in ("elbow", "wrist", "middle1"))
        forearm, palm = made[:, wrist] - made[:, elbow], made[:, knuckle] - made[:, wrist]
        cosine = (forearm * palm).sum(-1) / np.linalg.norm(forearm, axis=-1) / np.linalg.norm(palm, axis=-1)
        assert cosine.min() > 0.9
    flip = np.array([-1.0, 1.0, 1.0])
    other = with_resting_hands(body[:, BODY.mirror] * flip)
    np.testing.assert_allclose(other, made[:, WHOLE.mirror] * flip, atol=1e-7)


def test_other_skeletons_are_refused() -> None:
    with pytest.raises(UserError, match=r"joints \[T, 22, 3\], not to \[2, 52, 3\]"):
        with_resting_hands(np.zeros((2, 52, 3)))
