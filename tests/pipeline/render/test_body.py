"""The body: a closed surface, sound weights, scaled to any bones, with shapes that show."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
from gltf_validator import validated
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.expressions import APEX, BASIS
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid, with_offsets
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import (
    ARKIT,
    EXPRESSIONS,
    ArkitBases,
    expression_weights,
    synthetic_face_controls,
)
from motionloom.pipeline.render.body.glb import GlbClip, write_glb
from motionloom.pipeline.render.body.mesh import (
    FIRST_OF_HEAD,
    Body,
    asset,
    body_for,
    neutral_body,
    own_bases,
    posing_of,
    synthetic_arkit,
)
from motionloom.pipeline.render.viewer import (
    ViewerMotion,
    has_bodies,
    mesh_data,
    pack_turns,
    pose_data,
    viewer_script,
)

SMPLX = Skeleton.named("smplx52")
Walk = Callable[..., NDArray[np.float64]]


def numbers(text: str, kind: str) -> NDArray[np.generic]:
    return np.frombuffer(base64.b64decode(text), kind)


def dense(body: Body) -> NDArray[np.float64]:
    """Weights [V, N] in full precision."""
    out = np.zeros((len(body.vertices), len(body.skeleton)))
    np.add.at(out, (np.arange(len(out))[:, None], body.joints), body.shares)
    return out


def test_the_body_takes_other_bones() -> None:
    factors = np.random.default_rng(2).uniform(0.85, 1.2, size=(52, 1))
    other = with_offsets(SMPLX, SMPLX.offsets * factors)
    body, plain, weights = body_for(other), neutral_body(), dense(neutral_body())
    np.testing.assert_allclose(body_for(SMPLX).vertices, plain.vertices, atol=1e-12)
    # The shin's middle stays around the middle of the longer shin.
    for joint, child in (("left_knee", "left_ankle"), ("right_elbow", "right_wrist")):
        j, c = SMPLX.index(joint), SMPLX.index(child)
        mine = weights[:, j] > 0.97
        along = [
            (own.vertices[mine] - bones.rest_joints[j]) @ bones.offsets[c] / np.square(bones.offsets[c]).sum()
            for own, bones in ((body, other), (plain, SMPLX))
        ]
        assert along[0].min() > 0 and along[0].max() < 1.15  # a forearm's round end lies around the wrist
        assert along[0].mean() == pytest.approx(along[1].mean(), abs=0.03)
    doubled = body_for(with_offsets(SMPLX, 2 * SMPLX.offsets), EXPRESSIONS)
    np.testing.assert_allclose(doubled.vertices, 2 * plain.vertices, atol=1e-9)
    np.testing.assert_allclose(doubled.normals, plain.normals, atol=1e-9)
    np.testing.assert_allclose(doubled.shapes["happy"], 2 * plain.shapes["happy"], atol=1e-9)
    stiff = body_for(Skeleton.named("smpl22"))
    np.testing.assert_allclose(dense(stiff).sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(stiff.vertices, plain.vertices, atol=1e-9)
    with pytest.raises(UserError, match="smplx52 and smpl22"):
        body_for(Skeleton("odd", ("a", "b"), (-1, 0), ((0, 0, 0), (0, 1, 0))))


def test_the_synthetic_basis_moves_the_face_as_it_means() -> None:
    np.testing.assert_allclose(expression_weights(APEX * BASIS[:, :4].T), np.eye(8)[:4], atol=1e-9)
    happy, sad, angry, surprised = (synthetic_face_controls(APEX * BASIS[None, :, k])[0] for k in range(4))
    np.testing.assert_allclose(synthetic_face_controls(np.zeros((1, 50)))[0], [0, 0, 1, 0, 0])
    assert happy[0] > 0.9 and sad[4] > 0.9 and angry[1] < -0.5 < 0.5 < surprised[1] and surprised[2] > 1.3
    assert synthetic_face_controls(1.6 * BASIS[None, :, 4])[0, 2] == pytest.approx(0, abs=1e-6)
    # A blink in surprise shuts an eye that is wide open.
    both = expression_weights((APEX * BASIS[:, 3] + 1.6 * BASIS[:, 4])[None])[0]
    assert 1 + 0.6 * both[3] - both[4] == pytest.approx(0, abs=1e-9)


def test_synthetic_faces_become_the_arkit_shapes_that_mean_them() -> None:
    apex = [0 * BASIS[:, 0], APEX * BASIS[:, 0], APEX * BASIS[:, 1], APEX * BASIS[:, 3], 1.6 * BASIS[:, 4]]
    rows = np.stack(apex)
    weights = synthetic_arkit(rows)
    happy, sad, surprised, blink = (dict(zip(ARKIT, row, strict=True)) for row in weights[1:])
    assert weights[0].max() < 1e-6
    assert min(happy["mouthSmileLeft"], happy["mouthSmileRight"]) > 0.6
    assert min(sad["mouthFrownLeft"], sad["browInnerUp"]) > 0.4
    assert min(surprised["eyeWideLeft"], surprised["jawOpen"], surprised["browOuterUpRight"]) > 0.5
    assert min(blink["eyeBlinkLeft"], blink["eyeBlinkRight"]) > 0.9
    assert max(blink["jawOpen"], blink["mouthSmileLeft"]) < 0.05
    bases = own_bases()
    meant = expression_weights(rows) @ bases.source.reshape(len(bases.source), -1)
    missed = meant - weights @ bases.arkit.reshape(len(bases.arkit), -1)
    assert np.square(missed).mean() < 0.35**2 * np.square(meant).mean()


def unpacked(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Rotation matrices of 32-bit numbers, one at a time, from the words of `viewer`'s docstring."""
    out = []
    for value in packed.ravel().tolist():
        left, quaternion = value >> 30, np.zeros(4)
        for i, shift in ((1, 20), (2, 10), (3, 0)):
            quaternion[(left + i) % 4] = ((value >> shift & 1023) / 1022 - 0.5) * np.sqrt(2)
        quaternion[left] = np.sqrt(max(1 - quaternion @ quaternion, 0))
        out.append(Rotation.from_quat(quaternion).as_matrix())
    return np.array(out).reshape(*packed.shape, 3, 3)


def test_turns_travel_in_32_bits(walk: Walk) -> None:
    turns = Rotation.random(500, rng=np.random.default_rng(0)).as_matrix().reshape(100, 5, 3, 3)
    again = unpacked(pack_turns(turns))
    away = Rotation.from_matrix((again @ turns.swapaxes(-1, -2)).reshape(-1, 3, 3)).magnitude()
    assert np.degrees(away).max() < 0.3 and np.degrees(away).mean() < 0.12
    np.testing.assert_allclose(unpacked(pack_turns(np.eye(3)[None])), np.eye(3)[None], atol=1e-9)
    posing = posing_of(walk(4), SMPLX)
    data = pose_data(posing)
    leaves = set(range(52)) - set(SMPLX.parents)
    assert data["turning"][0] == 0 and not leaves & set(data["turning"])  # ends turn with their parents
    assert numbers(data["turns"], "<u4").size == 4 * len(data["turning"])
    with_neck = replace(posing, turns=posing.turns.copy())
    with_neck.turns[:, 15] = with_neck.turns[:, 15] @ Rotation.from_rotvec([0, 0.3, 0]).as_matrix()
    assert 15 in pose_data(with_neck)["turning"]


def test_pages_carry_the_body_only_where_someone_has_one(walk: Walk) -> None:
    chain = ViewerMotion(np.zeros((1, 3, 3)), 30, [-1, 0, 1])
    person = ViewerMotion(walk(2), 20, SMPLX.parents)
    assert not has_bodies([chain]) and has_bodies([chain, person])
    assert (
        len(viewer_script()) - len(viewer_script(False)) > 400_000 and len(json.dumps(mesh_data())) < 580_000
    )


@pytest.mark.slow
def test_the_file_is_what_its_script_makes(tmp_path: Path) -> None:
    script = Path(__file__).parents[3] / "benchmarks" / "body" / "make_body.py"
    subprocess.run([sys.executable, script, tmp_path / "body.npz"], check=True, capture_output=True)
    with np.load(tmp_path / "body.npz", allow_pickle=False) as made:
        assert made.keys() == asset().keys()
        for name, values in asset().items():
            if values.dtype.kind == "U":
                assert made[name].tolist() == values.tolist()
            elif name.endswith("_joints"):  # nearly equal shares change places, the least go
                size, shares = name.removesuffix("_joints"), name.replace("_joints", "_shares")
                ours, theirs = (_skin(one[name], one[shares]) for one in (asset(), made))
                np.testing.assert_allclose(theirs, ours, atol=2, err_msg=size)
            elif not name.endswith("_shares"):  # the last digit is the processor's
                np.testing.assert_allclose(made[name].astype(float), values.astype(float), atol=1, rtol=1e-6)


def _skin(joints: NDArray[np.generic], shares: NDArray[np.generic]) -> NDArray[np.float64]:
    """Share of each joint in each vertex."""
    out = np.zeros((len(joints), int(joints.max()) + 1))
    np.add.at(out, (np.arange(len(joints))[:, None], joints), shares)
    return out


# ARKit weights, and bases that are refused.


def test_shapes_that_move_nothing_stay_at_rest() -> None:
    arkit = np.zeros((52, 10, 3))
    arkit[3, :, 1] = 1.0
    weights = ArkitBases(0.5 * arkit[3:4], arkit).weights(np.ones((2, 1)))
    assert weights[:, 3] == pytest.approx(0.5, abs=1e-4)
    assert np.delete(weights, 3, axis=1).max() == 0


def test_bases_are_read_and_wrong_ones_refused(tmp_path: Path) -> None:
    path = tmp_path / "bases.npz"
    np.savez(path, source=np.ones((50, 4, 3), np.float32), arkit=np.ones((52, 4, 3), np.float32))
    assert ArkitBases.read(path).weights(np.zeros((3, 50))).shape == (3, 52)
    with pytest.raises(UserError, match="50 values"):
        ArkitBases.read(path).weights(np.zeros((3, 49)))
    np.savez(path, source=np.ones((50, 4, 3)), arkit=np.ones((51, 4, 3)))
    with pytest.raises(UserError, match=r"\[52, V, 3\]"):
        ArkitBases.read(path)
    np.savez(path, source=np.ones((50, 5, 3)), arkit=np.ones((52, 4, 3)))
    with pytest.raises(UserError, match="same"):
        ArkitBases.read(path)
    np.savez(path, source=np.full((50, 4, 3), np.nan), arkit=np.ones((52, 4, 3)))
    with pytest.raises(UserError, match="not finite"):
        ArkitBases.read(path)


# GLB files: what they hold against the figure, and Khronos' validator.

SKELETON = Skeleton.named("smplx52")
FPS = 20.0


@pytest.fixture(scope="module")
def clips(walk: Callable[..., NDArray[np.float64]]) -> list[GlbClip]:
    """A walk with a changing face, and a wave of other bone lengths without one."""
    frames = 40
    rise = np.linspace(0, 1, frames)[:, None]
    face = APEX * rise * BASIS[:, 0] + 1.6 * (np.arange(frames) % 10 == 0)[:, None] * BASIS[:, 4]
    first = fit_rigid(walk(frames), SKELETON)
    second = fit_rigid(1.06 * walk(30, wave=True, turn=0.0), SKELETON)
    return [
        GlbClip("a walk", first, FPS, expression_weights(face), {"fit_mean_mm": 0.1}),
        GlbClip("a wave <>&\"'é", second, FPS),
    ]


@pytest.fixture(scope="module")
def written(clips: list[GlbClip], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[RigidMotion]]:
    path = tmp_path_factory.mktemp("glb") / "motion.glb"
    return path, write_glb(path, clips)


def values(gltf: pygltflib.GLTF2, number: int) -> NDArray[Any]:
    """An accessor's numbers [count, width], read by hand."""
    accessor = gltf.accessors[number]
    view = gltf.bufferViews[accessor.bufferView]
    kind = {5126: "<f4", 5123: "<u2", 5121: "u1"}[accessor.componentType]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
    data = gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(data, kind).reshape(accessor.count, width)


def test_animations_hold_the_figures_rotations_root_and_times(
    written: tuple[Path, list[RigidMotion]], clips: list[GlbClip]
) -> None:
    path, figures = written
    gltf = pygltflib.GLTF2().load(path)
    assert [a.name for a in gltf.animations] == ["a walk", "a wave <>&\"'é"]
    assert gltf.animations[0].extras == {"fps": FPS, "fit_mean_mm": 0.1}
    for animation, figure, clip in zip(gltf.animations, figures, clips, strict=True):
        frames = len(figure.root)
        local = np.broadcast_to(np.eye(3), (frames, 52, 3, 3)).copy()
        root = None
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            times, keys = values(gltf, sampler.input)[:, 0], values(gltf, sampler.output)
            if len(times) > 1:
                np.testing.assert_allclose(times, np.arange(frames) / FPS, atol=1e-6)
            if channel.target.path == "rotation":
                name = gltf.nodes[channel.target.node].name
                local[:, SKELETON.index(name)] = Rotation.from_quat(keys).as_matrix()
                turned = np.einsum("tq,tq->t", keys[1:], keys[:-1])
                assert (turned > 0).all(), f"{name}: the long way round"
            elif channel.target.path == "translation":
                root = keys.astype(np.float64)
            else:
                assert clip.expression is not None
                np.testing.assert_allclose(keys.reshape(frames, -1), clip.expression, atol=1e-6)
        assert root is not None
        offsets = np.array([node.translation for node in gltf.nodes[:52]])
        joints, _ = forward_kinematics(local, root, offsets, SKELETON.parents)
        np.testing.assert_allclose(joints, figure.joints, atol=1e-5)
    # Motions of different bones share their mean.
    mean = np.mean([clip.figure.skeleton.offsets for clip in clips], axis=0)
    for figure, clip in zip(figures, clips, strict=True):
        np.testing.assert_allclose(figure.skeleton.offsets, mean, atol=1e-12)
        away = np.linalg.norm(figure.joints - clip.figure.joints, axis=-1)
        assert away.max() < 0.09  # 3 % of a leg, a trunk and the way


def skin_of(joints: NDArray[Any], shares: NDArray[Any]) -> NDArray[np.float64]:
    """Share of each joint in each vertex [V, 52]."""
    out = np.zeros((len(joints), 52))
    np.add.at(out, (np.arange(len(out))[:, None], joints), shares)
    return out


def test_meshes_are_the_body_and_joints_bind_at_rest(written: tuple[Path, list[RigidMotion]]) -> None:
    path, figures = written
    gltf, body = pygltflib.GLTF2().load(path), body_for(figures[0].skeleton, EXPRESSIONS)
    parts = [mesh.primitives[0] for mesh in gltf.meshes]
    places = np.concatenate([values(gltf, part.attributes.POSITION) for part in parts])
    assert len(places) == len(body.vertices)
    lift = [0.0, -body.vertices[:, 1].min(), 0.0]  # at rest it stands on the floor
    np.testing.assert_allclose(np.sort(places, axis=0), np.sort(body.vertices + lift, axis=0), atol=1e-6)
    assert abs(places[:, 1].min()) < 1e-6 and 1.5 < places[:, 1].max() < 2.0
    assert sum(gltf.accessors[part.indices].count for part in parts) == 3 * len(body.triangles)
    assert gltf.meshes[1].extras["targetNames"] == list(EXPRESSIONS)
    assert parts[0].targets in (None, []) and len(parts[1].targets) == len(EXPRESSIONS)
    for part in parts:
        shares = values(gltf, part.attributes.WEIGHTS_0).astype(np.float64)
        np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-6)
    head = body.swatch >= FIRST_OF_HEAD
    for part, mine in zip(parts, (~head, head), strict=True):
        named, shares = (values(gltf, n) for n in (part.attributes.JOINTS_0, part.attributes.WEIGHTS_0))
        np.testing.assert_allclose(skin_of(named, shares), skin_of(body.joints, body.shares)[mine], atol=1e-6)
    bind = values(gltf, gltf.skins[0].inverseBindMatrices).reshape(52, 4, 4).swapaxes(1, 2)
    rest = figures[0].skeleton.rest_joints
    np.testing.assert_allclose(bind[:, :3, 3], -rest - lift, atol=1e-6)
    np.testing.assert_allclose(gltf.nodes[0].translation, rest[0] + lift, atol=1e-6)


def test_a_head_can_carry_all_of_arkits_shapes(clips: list[GlbClip], tmp_path: Path) -> None:
    weights = np.linspace(0, 1, 40 * 52).reshape(40, 52)
    write_glb(tmp_path / "a.glb", [GlbClip("smile", clips[0].figure, FPS, weights)], "arkit")
    gltf = pygltflib.GLTF2().load(tmp_path / "a.glb")
    assert gltf.meshes[1].extras["targetNames"] == list(ARKIT)
    stored = [target["POSITION"] for target in gltf.meshes[1].primitives[0].targets]
    still = {number for number in stored if gltf.accessors[number].bufferView is None}
    assert len(stored) == 52 and len(still) == 1  # shapes that the head lacks share one that takes no room
    channel = next(c for c in gltf.animations[0].channels if c.target.path == "weights")
    keys = gltf.animations[0].samplers[channel.sampler].output
    np.testing.assert_allclose(values(gltf, keys).reshape(40, 52), weights, atol=1e-6)


@pytest.mark.browser
def test_khronos_validator_finds_nothing(
    written: tuple[Path, list[RigidMotion]], clips: list[GlbClip], tmp_path: Path
) -> None:
    report = validated(written[0])
    assert report["issues"]["messages"] == []
    assert report["info"]["animationCount"] == 2
    assert report["info"]["hasMorphTargets"] and report["info"]["hasSkins"]
    weights = np.linspace(0, 1, 40 * 52).reshape(40, 52)
    write_glb(tmp_path / "arkit.glb", [GlbClip("faces", clips[0].figure, FPS, weights)], "arkit")
    assert validated(tmp_path / "arkit.glb")["issues"]["messages"] == []
    body = Skeleton.named("smpl22")
    small = fit_rigid(clips[0].figure.joints[:, :22], body)
    write_glb(tmp_path / "small.glb", [GlbClip("no fingers", small, FPS)])
    assert validated(tmp_path / "small.glb")["issues"]["messages"] == []
