"""The skinned body: a closed surface, sound weights, scaled to any bones, expressions that show."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.rigid import with_offsets
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.face import APEX, BASIS
from motionloom.pipeline.render.body.face import EXPRESSIONS, expression_weights
from motionloom.pipeline.render.body.field import Capsule, Field
from motionloom.pipeline.render.body.mesh import _whole_body, body_for, colour_strip, neutral_body
from motionloom.pipeline.render.body.palette import PALETTE
from motionloom.pipeline.render.body.surface import mesh_of, surface_nets
from motionloom.pipeline.render.face import synthetic_face_controls

SKELETON = Skeleton.named("smplx52")


def edges_of(triangles: np.ndarray) -> Counter[tuple[int, int]]:
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return Counter(map(tuple, sides.tolist()))


def test_surface_nets_close_around_a_ball_and_face_outward() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(14.0)] * 3, indexing="ij"), -1)
    values = np.linalg.norm(grid - 6.3, axis=-1) - 4.0
    points, triangles = surface_nets(values)
    assert np.abs(np.linalg.norm(points - 6.3, axis=-1) - 4.0).max() < 0.35
    count = edges_of(triangles)
    assert all(count[b, a] == 1 == n for (a, b), n in count.items())
    assert len(points) - len(count) // 2 + len(triangles) == 2  # Euler: a sphere
    a, b, c = (points[triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", np.cross(a, b), c).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 4.0**3, rel=0.1)  # chords of a coarse grid


def test_a_fields_gradient_is_its_difference_quotient_and_vertices_lie_on_it() -> None:
    thin = Capsule(1, (0.3, 0.1, 0), (0.4, 0.3, 0.1), 0.04, 0.02, 0.8)
    field = Field([Capsule(0, (0, 0, 0), (0.3, 0.1, 0), 0.05, 0.03), thin], 0.01)
    points = np.random.default_rng(0).uniform(-0.1, 0.45, size=(200, 3))
    slope = np.stack(
        [(field.value(points + d) - field.value(points - d)) / 2e-6 for d in 1e-6 * np.eye(3)], axis=-1
    )
    unit = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    np.testing.assert_allclose(field.normals(points), unit, atol=1e-5)
    vertices, _ = mesh_of(field, 0.01)
    assert np.abs(field.value(vertices)).max() < 1e-9


def test_the_body_is_small_closed_and_the_same_every_time() -> None:
    body = neutral_body()
    assert len(body.vertices) <= 15_000
    assert np.isfinite(body.vertices).all()
    np.testing.assert_allclose(np.linalg.norm(body.normals, axis=-1), 1, atol=1e-9)
    height = np.ptp(body.vertices[:, 1])
    assert 1.55 < height < 1.85
    # Trunk, hands, head and nose are closed; the flat features on the face have borders.
    count = edges_of(body.triangles)
    open_edges = [edge for edge, n in count.items() if count[edge[::-1]] != n]
    face_first = min(min(edge) for edge in open_edges)
    assert (body.weights[face_first:, SKELETON.index("head")] == 1).all()
    again = _whole_body.__wrapped__()
    np.testing.assert_array_equal(again.vertices, body.vertices)
    np.testing.assert_array_equal(again.weights, body.weights)


def test_weights_are_shares_of_a_few_joints_of_one_side() -> None:
    body = neutral_body()
    np.testing.assert_allclose(body.weights.sum(axis=1), 1, atol=1e-12)
    assert (body.weights > 0).sum(axis=1).max() <= 4
    left = [j for j, name in enumerate(SKELETON.joints) if name.startswith("left")]
    right = [j for j, name in enumerate(SKELETON.joints) if name.startswith("right")]
    limbs = [
        j for j in (*left, *right) if "hip" not in SKELETON.joints[j] and "collar" not in SKELETON.joints[j]
    ]
    of_left = body.weights[:, [j for j in limbs if j in left]].sum(axis=1)
    of_right = body.weights[:, [j for j in limbs if j in right]].sum(axis=1)
    assert not ((of_left > 0) & (of_right > 0)).any()
    # Every joint but the ends that nothing hangs on moves something.
    assert (body.weights.max(axis=0) > 0.5).sum() >= 50


def test_posed_vertices_follow_their_bones() -> None:
    """Against a slow loop over a few vertices, and rigidly where one joint has all the weight."""
    body = neutral_body()
    rng = np.random.default_rng(1)
    local = Rotation.from_rotvec(0.5 * rng.normal(size=(2 * 52, 3))).as_matrix().reshape(2, 52, 3, 3)
    root = rng.normal(size=(2, 3))
    posed = body.posed(local, root)
    joints, world = forward_kinematics(local, root, SKELETON.offsets, SKELETON.parents)
    rest = SKELETON.rest_joints
    for vertex in rng.integers(0, len(body.vertices), 20):
        expected = np.zeros((2, 3))
        for joint, weight in enumerate(body.weights[vertex]):
            if weight:
                away = body.vertices[vertex] - rest[joint]
                expected += weight * (joints[:, joint] + world[:, joint] @ away)
        np.testing.assert_allclose(posed[:, vertex], expected, atol=1e-12)


def test_left_is_blue_right_is_orange_and_the_trunk_is_neither() -> None:
    body, strip = neutral_body(), colour_strip()
    high, wide = strip.shape[:2]

    def colour(points: np.ndarray) -> np.ndarray:
        return strip[(points[:, 1] * high).astype(int), (points[:, 0] * wide).astype(int)]

    for joint, code in (
        ("left_knee", 1),
        ("left_index2", 1),
        ("right_elbow", 2),
        ("right_foot", 2),
        ("spine2", 0),
    ):
        mine = body.weights.argmax(axis=1) == SKELETON.index(joint)
        assert mine.sum() > 20
        np.testing.assert_array_equal(colour(body.uv[mine]), np.tile(PALETTE[code], (mine.sum(), 1)))


def test_the_body_takes_other_bones() -> None:
    rng = np.random.default_rng(2)
    other = with_offsets(SKELETON, SKELETON.offsets * rng.uniform(0.85, 1.2, size=(52, 1)))
    body = body_for(other)
    np.testing.assert_allclose(body_for(SKELETON).vertices, neutral_body().vertices, atol=1e-12)
    # The shin's middle stays around the middle of the longer shin.
    for joint, child in (("left_knee", "left_ankle"), ("right_elbow", "right_wrist")):
        j, c = SKELETON.index(joint), SKELETON.index(child)
        mine = body.weights[:, j] > 0.97
        bone = other.offsets[c]
        along = (body.vertices[mine] - other.rest_joints[j]) @ bone / (bone @ bone)
        assert along.min() > 0 and along.max() < 1.15  # a forearm's round end lies around the wrist
        assert along.mean() == pytest.approx(
            ((neutral_body().vertices[mine] - SKELETON.rest_joints[j]) @ SKELETON.offsets[c]
             / (SKELETON.offsets[c] @ SKELETON.offsets[c])).mean(), abs=0.03
        )  # fmt: skip
    doubled = body_for(with_offsets(SKELETON, 2 * SKELETON.offsets))
    np.testing.assert_allclose(doubled.vertices, 2 * neutral_body().vertices, atol=1e-9)
    np.testing.assert_allclose(
        doubled.expressions["happy"], 2 * neutral_body().expressions["happy"], atol=1e-9
    )


def test_a_skeleton_without_fingers_has_stiff_hands_and_a_strange_one_no_body() -> None:
    small = Skeleton.named("smpl22")
    body = body_for(small)
    assert body.weights.shape[1] == 22
    np.testing.assert_allclose(body.weights.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(body.vertices, neutral_body().vertices, atol=1e-9)
    with pytest.raises(UserError, match="smplx52 and smpl22"):
        body_for(Skeleton("odd", ("a", "b"), (-1, 0), ((0, 0, 0), (0, 1, 0))))


def test_each_column_of_the_synthetic_basis_has_its_expression() -> None:
    names = list(EXPRESSIONS)
    for k in range(4):
        weights = expression_weights((APEX * BASIS[:, k])[None])[0]
        expected = np.zeros(8)
        expected[k] = 1
        np.testing.assert_allclose(weights, expected, atol=1e-9)
        # The look of the morph target is what the drawn face shows.
        smile, brow, eye, mouth, frown = synthetic_face_controls((APEX * BASIS[:, k])[None])[0]
        look = EXPRESSIONS[names[k]]
        assert (look.smile, look.brow, look.eye_open, look.mouth_open, look.frown) == pytest.approx(
            (smile, brow, eye, mouth, frown)
        )
    both = expression_weights((APEX * BASIS[:, 3] + 1.6 * BASIS[:, 4])[None])[0]
    opened = 1 + sum(w * (look.eye_open - 1) for w, look in zip(both, EXPRESSIONS.values(), strict=True))
    assert opened == pytest.approx(0, abs=1e-9)


def test_expressions_move_the_face_and_nothing_else() -> None:
    body = neutral_body()
    head = body.weights[:, SKELETON.index("head")]
    for name, move in body.expressions.items():
        size = np.linalg.norm(move, axis=-1)
        assert 0.003 < size.max() < 0.03, name
        assert size[head < 0.2].max() < 1e-3, name
    # Corners of the mouth: up in joy, down in sorrow.
    lips = np.flatnonzero(np.abs(body.uv - [0.7, 0.625]).max(axis=1) < 1e-6)
    outer = lips[body.vertices[lips, 0].argmax()]
    assert body.expressions["happy"][outer, 1] > 0 > body.expressions["sad"][outer, 1]
