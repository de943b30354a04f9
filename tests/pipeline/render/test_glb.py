"""GLB files: what they hold against the figure, and Khronos' validator."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.expressions import APEX, BASIS
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import ARKIT, EXPRESSIONS, expression_weights
from motionloom.pipeline.render.body.glb import GlbClip, write_glb
from motionloom.pipeline.render.body.mesh import FIRST_OF_HEAD, body_for

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
        assert away.max() < 0.06  # 3 % of a leg and a trunk


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


VALIDATE = """
import { pathToFileURL } from "node:url";
import fs from "node:fs";
const { default: validator } = await import(pathToFileURL(process.argv[1]).href);
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])));
console.log(JSON.stringify(report));
"""


def validated(path: Path) -> dict[str, Any]:
    """The validator's report; skips where it is not: `MOTIONLOOM_NODE_MODULES` names a folder that has it."""
    module = Path(os.environ.get("MOTIONLOOM_NODE_MODULES", "")) / "gltf-validator" / "index.js"
    node = shutil.which("node")
    if node is None or not module.is_file():
        pytest.skip("MOTIONLOOM_NODE_MODULES names no folder with gltf-validator, or there is no node")
    command = [node, "--input-type=module", "-e", VALIDATE, str(module), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    report: dict[str, Any] = json.loads(done.stdout)
    return report


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
