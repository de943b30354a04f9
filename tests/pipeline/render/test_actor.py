"""The body in film and pictures, and as the page has it: against slow loops and the GLB's own skinning."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.rigid import fit_rigid
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.actor import BodyActor, PlainActor, actor_for, draw_actor
from motionloom.pipeline.render.body.embed import DETAILS, in_reach, mesh_data, pack_turns, pose_data
from motionloom.pipeline.render.body.face import CONTROLS, EXPRESSIONS, control_weights
from motionloom.pipeline.render.body.mesh import body_for, neutral_body
from motionloom.pipeline.render.body.posing import human_skeleton, posing_of, single_bones
from motionloom.pipeline.render.camera import Camera
from motionloom.pipeline.render.lighting import LAMP, cast_shadow
from motionloom.pipeline.render.raster import cover
from motionloom.pipeline.render.viewer import ViewerMotion, has_bodies, viewer_data, viewer_script

SMPLX = Skeleton.named("smplx52")
Walk = Callable[..., np.ndarray]


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def unpacked(packed: np.ndarray) -> np.ndarray:
    """Rotation matrices of 32-bit numbers, one at a time, from the words of `embed`'s docstring."""
    out = []
    for value in packed.ravel().tolist():
        left, quaternion = value >> 30, np.zeros(4)
        for i, shift in ((1, 20), (2, 10), (3, 0)):
            quaternion[(left + i) % 4] = ((value >> shift & 1023) / 1022 - 0.5) * np.sqrt(2)
        quaternion[left] = np.sqrt(max(1 - quaternion @ quaternion, 0))
        out.append(Rotation.from_quat(quaternion).as_matrix())
    return np.array(out).reshape(*packed.shape, 3, 3)


def test_cover_is_what_a_loop_over_pixels_finds() -> None:
    rng = np.random.default_rng(0)
    points, nearness = rng.uniform(-6, 38, (60, 2)), rng.uniform(0.2, 1, 60)
    triangles = rng.integers(0, 60, (40, 3))
    for both in (False, True):
        found = cover(points, nearness, triangles, (32, 24), both_sides=both)
        seen = dict(zip(found.pixels.tolist(), found.triangles.tolist(), strict=True))
        for pixel in range(32 * 24):
            middle = np.array([pixel % 32 + 0.5, pixel // 32 + 0.5])
            best, front = None, -np.inf
            for number, (a, b, c) in enumerate(points[triangles]):
                matrix = np.stack([b - a, c - a], axis=1)
                size = np.linalg.det(matrix)
                if abs(size) < 1e-9 or (size > 0 and not both):
                    continue
                shares = np.linalg.solve(matrix, middle - a)
                shares = np.array([1 - shares.sum(), *shares])
                near = shares @ nearness[triangles[number]]
                if (shares >= 0).all() and near > front:
                    best, front = number, near
            assert seen.get(pixel) == best
        where = np.einsum("pk,pkc->pc", found.shares, points[triangles[found.triangles]])
        middles = np.stack([found.pixels % 32 + 0.5, found.pixels // 32 + 0.5], axis=1)
        np.testing.assert_allclose(where, middles, atol=1e-9)


def test_a_rigid_figure_is_skinned_as_its_glb_is(walk: Walk) -> None:
    figure = fit_rigid(walk(6, wave=True), SMPLX)
    actor = actor_for(figure.joints, SMPLX.parents, figure)
    assert isinstance(actor, BodyActor)
    same = body_for(figure.skeleton, "controls", "near").posed(figure.rotations, figure.root)
    np.testing.assert_allclose(actor.at(4)[0], same[4], atol=1e-9)
    # Bare joints of the same motion give the same body: nothing in them is twisted.
    bare = actor_for(figure.joints, SMPLX.parents)
    np.testing.assert_allclose(bare.at(4)[0], same[4], atol=5e-3)
    with pytest.raises(UserError, match="figure of"):
        actor_for(figure.joints[:3], SMPLX.parents, figure)


@pytest.mark.parametrize("joints", [52, 22])
def test_bones_that_change_length_still_end_at_the_joints(walk: Walk, joints: int) -> None:
    skeleton = SMPLX if joints == 52 else Skeleton.named("smpl22")
    loose = walk(5)[:, :joints] + np.random.default_rng(0).normal(0, 0.01, (5, joints, 3))
    posing = posing_of(loose, skeleton)
    ends, starts = single_bones(skeleton)
    bones, own = posing.bones(), posing.skeleton
    for end, start in zip(ends, starts, strict=True):
        now = np.linalg.norm(loose[:, end] - loose[:, start], axis=-1) / np.linalg.norm(own.offsets[end])
        reached = loose[:, start] + bones[:, start] @ own.offsets[end]
        kept = (now > 0.5) & (now < 2)
        # A wrist's share of the twist turns forearms about themselves: that moves no end.
        np.testing.assert_allclose(reached[kept], loose[kept, end], atol=1e-9)
    assert human_skeleton(skeleton.parents) == skeleton and human_skeleton([-1, 0]) is None


def test_turned_normals_stand_on_the_skin(walk: Walk) -> None:
    actor = actor_for(walk(3, wave=True), SMPLX.parents)
    vertices, normals = actor.at(2)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    a, b, c = (vertices[actor.triangles[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    size = np.linalg.norm(flat, axis=1)
    some = size > 1e-8  # a shut mouth has no area
    along = np.einsum("fi,fi->f", flat[some] / size[some, None], normals[actor.triangles[some, 0]])
    assert np.median(along) > 0.97 and (along > 0).mean() > 0.98


def test_controls_move_the_face_as_the_expressions_do() -> None:
    full, drawn = neutral_body(), neutral_body("smplx52", "controls")
    np.testing.assert_array_equal(full.vertices, drawn.vertices)
    moves = np.stack(list(drawn.expressions.values()))
    for name in ("happy", "sad", "angry", "surprised", "blink"):
        look = EXPRESSIONS[name]
        controls = [[look.smile, look.brow, look.eye_open, look.mouth_open, look.frown]]
        sum_of = np.einsum("e,evc->vc", control_weights(np.array(controls))[0], moves)
        assert np.linalg.norm(sum_of - full.expressions[name], axis=1).max() < 2.5e-3, name
    np.testing.assert_array_equal(control_weights(np.array([[0, 0, 1, 0, 0.0]])), 0)
    assert list(CONTROLS) == list(drawn.expressions)


def test_turns_travel_in_32_bits(walk: Walk) -> None:
    rng = np.random.default_rng(0)
    turns = Rotation.random(500, rng=rng).as_matrix().reshape(100, 5, 3, 3)
    again = unpacked(pack_turns(turns))
    away = Rotation.from_matrix((again @ turns.swapaxes(-1, -2)).reshape(-1, 3, 3)).magnitude()
    assert np.degrees(away).max() < 0.3 and np.degrees(away).mean() < 0.12
    np.testing.assert_allclose(unpacked(pack_turns(np.eye(3)[None])), np.eye(3)[None], atol=1e-9)
    posing = posing_of(walk(4), SMPLX)
    data = pose_data(posing)
    turning = data["turning"]
    leaves = set(range(52)) - set(SMPLX.parents)
    assert turning[0] == 0 and not leaves & set(turning)  # end joints turn with their parents
    assert numbers(data["turns"], "<u4").size == 4 * len(turning)
    np.testing.assert_allclose(
        numbers(data["rest"], "<f4").reshape(52, 3), posing.skeleton.rest_joints, atol=1e-6
    )
    with_neck = replace(posing, turns=posing.turns.copy())
    with_neck.turns[:, 15] = with_neck.turns[:, 15] @ Rotation.from_rotvec([0, 0.3, 0]).as_matrix()
    assert 15 in pose_data(with_neck)["turning"]


def test_the_pages_mesh_is_the_body_in_small_numbers() -> None:
    data = mesh_data()
    assert len(json.dumps(data)) < 520_000
    for raw, detail in zip(data["details"], DETAILS, strict=True):
        triangles, count = numbers(raw["triangles"], "<u2"), raw["count"]
        assert triangles.max() < count
        if detail == "shadow":  # it has no face, and nobody looks at it
            assert len(raw["moves"]) == 0
            continue
        body = in_reach(neutral_body("smplx52", "controls", detail))
        places = np.array(raw["low"]) + np.array(raw["step"]) * numbers(raw["places"], "<u2").reshape(
            count, 3
        )
        assert np.abs(places - body.vertices).max() < 5e-5
        shares = numbers(raw["shares"], "u1").reshape(count, 4)
        assert (shares.astype(int).sum(axis=1) == 255).all()
        weights = np.zeros((count, 52))
        np.add.at(
            weights, (np.arange(count)[:, None], numbers(raw["joints"], "u1").reshape(count, 4)), shares / 255
        )
        assert np.abs(weights - body.weights).max() < 0.01
        np.testing.assert_array_equal(triangles.reshape(-1, 3), body.triangles)
    near, far, shadow = (raw["count"] for raw in data["details"])
    assert near > far > shadow
    # In order, a small memory of vertices is enough.
    body = in_reach(neutral_body("smplx52", "controls", "far"))
    recent, missed = [-1] * 64, 0
    for vertex in body.triangles.ravel().tolist():
        missed += recent[vertex % 64] != vertex
        recent[vertex % 64] = vertex
    assert missed < 1.6 * len(body.vertices)


def test_pages_carry_the_body_only_where_someone_has_one(walk: Walk) -> None:
    chain = ViewerMotion(np.zeros((1, 3, 3)), 30, [-1, 0, 1])
    assert not has_bodies(viewer_data([chain])) and has_bodies(
        viewer_data([chain, ViewerMotion(walk(2), 20, SMPLX.parents)])
    )
    assert len(viewer_script()) - len(viewer_script(False)) > 400_000


def picture(actor: Any, view: tuple[float, float] = (0.0, 0.08)) -> np.ndarray:
    image = np.full((240, 200, 3), 250, np.uint8)
    draw_actor(image, Camera(*view, 5.0, 200, 240), np.array([0, 0.85, 0]), 0.0, actor, 0)
    return image.astype(int)


def test_the_face_shows_and_the_shadow_lies_away_from_the_lamp(walk: Walk) -> None:
    standing = SMPLX.rest_joints[None] + [0, 0.95, 0]
    calm = picture(actor_for(standing, SMPLX.parents))
    glad = picture(actor_for(standing, SMPLX.parents, None, np.array([[1, 1, 1.6, 0.9, 0.0]])))
    assert (np.abs(calm - glad).max(axis=-1) > 30).sum() > 8
    from_above = picture(actor_for(standing, SMPLX.parents), (0.0, 1.3))
    grey = (from_above.max(axis=-1) < 245) & (np.ptp(from_above, axis=-1) < 12)
    assert grey.sum() > 300
    rows, columns = np.nonzero(grey)
    # Light comes from the left and from ahead: on the picture the shadow is to the right and above.
    assert LAMP[0] < 0 < LAMP[2]
    assert columns.mean() > 100 and rows.mean() < 120
    image = np.full((240, 200, 3), 250, np.uint8)
    body = neutral_body("smplx52", "controls", "far")
    cast_shadow(image, Camera(0.0, -0.1, 5.0, 200, 240), np.zeros(3), -1.0, body.vertices, body.triangles)
    assert (image == 250).all()  # from below the ground nothing is seen of it


def test_unknown_skeletons_are_closed_tubes_of_their_bones() -> None:
    joints = np.array([[[0, 1, 0], [0, 1.5, 0], [0, 1.8, 0], [0.5, 1, 0], [-0.5, 1, 0]]], float)
    actor = actor_for(joints, [-1, 0, 1, 0, 0])
    assert isinstance(actor, PlainActor)
    vertices, normals = actor.at(0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    for capsule, places in zip(actor.figure.capsules, np.split(vertices, 4), strict=True):
        a, b = joints[0, capsule.a], joints[0, capsule.b]
        share = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        radius = np.linalg.norm(places - (a + share[:, None] * (b - a)), axis=1)
        assert radius.min() > 0.9 * capsule.rb and radius.max() < 1.01 * capsule.ra
    corners = vertices[actor.triangles]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.einsum("fi,fi->f", flat, normals[actor.triangles].sum(axis=1))
    assert (outward > -1e-12).all()
    image = picture(actor)
    blue, orange = (np.abs(image - c).max(axis=-1) < 60 for c in ((47, 143, 196), (229, 121, 63)))
    assert blue.sum() > 40 and orange.sum() > 40
    assert np.nonzero(blue)[1].mean() > np.nonzero(orange)[1].mean() + 20
