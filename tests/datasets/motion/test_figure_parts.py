"""Parts of a figure: columns by the joints that they are of, and joints that are moved where they must be."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.motion.body.rigid import fit_rigid
from motionloom.datasets.motion.easing import eased
from motionloom.datasets.motion.layout import (
    PIECES,
    FigurePart,
    MotionLayout,
    piece_columns,
    piece_joints,
    pieces_of,
    step_columns,
)
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.editing.landing import landed, reached

SIDES = ("left", "right")
ARMS = ["left_shoulder", "left_elbow", "left_wrist"]
LEGS = [
    "pelvis",
    *(f"{side}_{name}" for name in ("hip", "knee", "ankle", "foot") for side in ("left", "right")),
]
TRUNK = ["spine1", "spine2", "spine3", "neck", "left_collar", "right_collar", "head"]


@pytest.mark.parametrize(
    ("part", "joints", "more"),
    [
        ("left_arm", ARMS, 0),
        ("lower", LEGS, 0),
        ("upper", [*TRUNK, *ARMS, *(name.replace("left", "right") for name in ARMS)], 30),
        ("left_hand", [], 15),
        ("hands", [], 30),
        ("all", [*LEGS, *TRUNK, *ARMS, *(name.replace("left", "right") for name in ARMS)], 30),
        ("face", [], 0),
    ],
)
def test_parts_are_their_joints(part: FigurePart, joints: list[str], more: int) -> None:
    layout = MotionLayout.named("wholebody363")
    mine = pieces_of([part])[piece_joints(layout)]
    found = {name for name, own in zip(layout.skeleton.joints, mine, strict=True) if own}
    assert set(joints) <= found
    assert len(found) == len(joints) + more
    assert all("hand" in part or part in ("upper", "all") for name in found - set(joints))


@pytest.mark.parametrize("name", ["body133", "wholebody363", "h3d263", "tomato623"])
def test_every_column_is_of_one_piece(name: str) -> None:
    layout = MotionLayout.named(name)
    of, joints = piece_columns(layout), piece_joints(layout)
    np.testing.assert_array_equal(of[layout.slice("positions")][::3], joints[1:])
    np.testing.assert_array_equal(of[layout.slice("velocities")][2::3], joints)
    hands = np.isin(of, [PIECES.index("left_hand"), PIECES.index("right_hand")])
    assert hands.sum() == (len(layout.part("hand")) if layout.num_joints > 22 else 0)
    assert step_columns(layout)[layout.slice("velocities")].all()
    assert not step_columns(layout)[layout.slice("positions")].any()


def test_parts_without_others() -> None:
    kept = pieces_of(["all"], but=["right_hand", "face"])
    assert [name for name, one in zip(PIECES, kept, strict=True) if not one] == ["right_hand", "face"]


def test_values_are_eased_between_what_is_known() -> None:
    known = np.zeros(21, dtype=bool)
    known[[0, 10, 20]] = True
    values = np.zeros(21)
    values[[0, 10, 20]] = [0.0, 1.0, -1.0]
    found = eased(values, known)
    np.testing.assert_array_equal(found[known], values[known])
    assert (np.diff(found[:11]) > 0).all()
    # Level at both ends: the first step is a small part of the largest.
    assert found[1] < 0.3 * np.diff(found[:11]).max()
    assert not eased(values, np.zeros(21, dtype=bool)).any()


def test_figures_land_where_they_must() -> None:
    joints = np.random.default_rng(0).normal(size=(5, 22, 3))
    moved, heading = landed(joints, np.zeros(5), np.full(5, 2 + 1j), np.full(5, np.pi / 2))
    np.testing.assert_allclose(moved[:, 0] - joints[:, 0], [[1, 0, 2]] * 5, atol=1e-12)
    local, before = moved - moved[:, :1], joints - joints[:, :1]
    np.testing.assert_allclose(local[..., [0, 1, 2]], before[..., [2, 1, 0]] * [1, 1, -1], atol=1e-12)
    np.testing.assert_allclose(heading, np.pi / 2)


def test_a_pinned_hand_takes_its_limb_along() -> None:
    skeleton = Skeleton.named("smplx52")
    figure = fit_rigid(np.repeat(skeleton.rest_joints[None] + [0, 1, 0], 30, axis=0), skeleton)
    joints, wrist = figure.joints, skeleton.index("left_wrist")
    wanted = joints[15, wrist] + [-0.1, 0.25, 0.1]
    fixed = np.zeros((30, 52), dtype=bool)
    fixed[:, [skeleton.index(f"{side}_foot") for side in SIDES]] = True
    fixed[:10] = True
    found = reached(figure, {(15, wrist): wanted}, fixed, 10, lambda made: made).joints
    assert np.linalg.norm(found[15, wrist] - wanted) < 0.001
    np.testing.assert_allclose(found[fixed], joints[fixed], atol=0.01)
    np.testing.assert_allclose(found[np.r_[:10, 25:30]], joints[np.r_[:10, 25:30]], atol=1e-9)
    bones = np.linalg.norm(skeleton.bones(found[15]), axis=-1)
    np.testing.assert_allclose(bones, np.linalg.norm(figure.skeleton.offsets, axis=-1), atol=1e-9)
    assert np.linalg.norm(np.diff(found[:, wrist], axis=0), axis=-1).max() < 0.1  # no jump
