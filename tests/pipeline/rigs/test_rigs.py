"""Motions on characters of others, by kinematics of the test's own, Khronos' validator and three-vrm."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_validator import validated
from numpy.typing import NDArray
from rig_characters import OURS, character, write
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.expressions import APEX, BASIS
from motionloom.datasets.motion.body.retarget import on_bones
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.clip_file import read_clip
from motionloom.pipeline.inference.files.outputs import write_motions
from motionloom.pipeline.inference.files.writers import default_formats, figure_options
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.rigs.animations import SUFFIX, read_animation
from motionloom.pipeline.rigs.gltf import Gltf
from motionloom.pipeline.rigs.names import HUMANOID
from motionloom.pipeline.rigs.rig import Rig

Floats = NDArray[np.float64]
LIMBS = [
    (joint, parent)
    for joint, parent in enumerate(OURS.parents)
    if OURS.joints[parent].endswith(("hip", "knee", "shoulder", "elbow")) or parent >= 22
]
"""Ends of bones that point where they do in the motion, and the joints that turn them."""


def played(gltf: Gltf, animation: int = 0) -> tuple[Floats, Floats]:
    """World places [T, N, 3] and rotations [T, N, 3, 3] of all nodes, by the test's own kinematics."""
    tracks: dict[tuple[int, str], Floats] = {}
    about = gltf.json["animations"][animation]
    for channel in about["channels"]:
        keys = gltf.values(about["samplers"][channel["sampler"]]["output"])
        tracks[channel["target"]["node"], channel["target"]["path"]] = keys
    frames = max(len(keys) for (_, path), keys in tracks.items() if path != "weights")
    worlds = np.tile(np.eye(4), (frames, len(gltf.parents), 1, 1))
    for node in gltf.in_order():
        place, turn, scale = gltf.local(node)
        moved = np.broadcast_to(tracks.get((node, "translation"), place[None]), (frames, 3))
        quaternions = tracks.get((node, "rotation"))
        turned = np.tile(turn, (frames, 1, 1))
        if quaternions is not None:
            turned[:] = Rotation.from_quat(quaternions).as_matrix()
        worlds[:, node, :3, :3] = turned * scale
        worlds[:, node, :3, 3] = moved
        if gltf.parents[node] >= 0:
            worlds[:, node] = worlds[:, gltf.parents[node]] @ worlds[:, node]
    size = np.linalg.norm(worlds[..., :3, :3], axis=-2, keepdims=True)
    return worlds[..., :3, 3], worlds[..., :3, :3] / size


@pytest.fixture
def motion(walk: Callable[..., Floats]) -> GeneratedMotion:
    """A walk with moving fingers, a turning head, and a face that smiles more and more."""
    figure = fit_rigid(walk(40), OURS)
    rotations = figure.rotations.copy()
    sway = 0.4 * np.sin(np.arange(40) / 5)
    rotations[:, OURS.index("head")] = Rotation.from_euler("y", sway[:, None]).as_matrix()
    for joint in range(22, 52):
        rotations[:, joint] = Rotation.from_rotvec(np.outer(sway, [0.3, 0.2, 1.0])).as_matrix()
    joints, _ = forward_kinematics(rotations, figure.root, figure.skeleton.offsets, OURS.parents)
    figure = RigidMotion.posed(figure.skeleton, rotations, figure.root, joints)
    face = (APEX * np.linspace(0, 1, 40)[:, None] * BASIS[:, 0]).astype(np.float32)
    layout = MotionLayout.named("wholebody363", fps=20.0)
    return GeneratedMotion(
        Prompt("a person walks"), np.zeros((40, layout.dim - 50), np.float32), figure.joints, face, layout,
        figure=figure,
    )  # fmt: skip


def angles(one: Floats, other: Floats) -> Floats:
    both = (one * other).sum(axis=-1) / np.linalg.norm(one, axis=-1) / np.linalg.norm(other, axis=-1)
    return np.degrees(np.arccos(np.clip(both, -1, 1)))


@pytest.mark.parametrize("maker", ["vrm0", "vrm1", "mixamo", "rigify", "unreal"])
def test_a_character_moves_as_the_motion_does(tmp_path: Path, motion: GeneratedMotion, maker: str) -> None:
    lacks = ("left_foot", "right_foot", "spine2") if maker == "vrm1" else ()
    nodes = character(tmp_path / "hero.glb", maker, lacks=lacks)
    said: list[str] = []
    options = figure_options({"rig": str(tmp_path / "hero.glb")}, ["rig"])
    [path] = write_motions(tmp_path / "out", [motion], ["rig"], title="", figure=options, say=said.append)
    assert bool(lacks) == any("left_foot" in line for line in said)
    gltf = Gltf.read(path)
    places, turns = played(gltf)
    rest, rest_turns = (one[0] for one in played_at_rest(gltf))
    figure = motion.figure
    assert figure is not None
    front = np.diag([-1.0, 1.0, -1.0]) if maker == "vrm0" else np.eye(3)
    # Limbs and fingers point where they do in the motion.
    for joint, parent in LIMBS:
        if OURS.joints[joint] not in lacks:
            bone = places[:, nodes[OURS.joints[joint]]] - places[:, nodes[OURS.joints[parent]]]
            way = figure.joints[:, joint] - figure.joints[:, parent]
            assert angles(bone @ front.T, way).max() < 1, OURS.joints[joint]
    # Head, hips and feet are turned as they are in the motion.
    _, world = forward_kinematics(figure.rotations, figure.root, figure.skeleton.offsets, OURS.parents)
    for name in ("head", "pelvis", "left_ankle", *(() if lacks else ("right_foot",))):
        node, joint = nodes[name], OURS.index(name)
        turned = front @ turns[:, node] @ rest_turns[node].T @ front.T
        assert angles(turned[..., 2], world[:, joint, :, 2]).max() < (1 if "ankle" not in name else 6)
    # Its feet reach its floor, and it goes as much farther as its legs are longer.
    low = places[:, [nodes["left_ankle"], nodes["right_ankle"]], 1].min()
    assert abs(low - rest[[nodes["left_ankle"], nodes["right_ankle"]], 1].min()) < 0.04
    one, other = (way[-1] - way[0] for way in (places[:, nodes["pelvis"]], figure.root))
    longer = 1.15 * OURS.rest_joints[7, 1] / figure.skeleton.rest_joints[7, 1]
    assert np.hypot(one[0], one[2]) / np.hypot(other[0], other[2]) == pytest.approx(longer, rel=0.05)
    # Read again as a clip, it is the motion.
    clip = read_bvh(read_animation(path / f"00-walk{SUFFIX}", "walk"))
    back, row = clip.positions(), [clip.joints.index(name) for name in OURS.joints]
    for joint, parent in LIMBS:
        bone = back[:, row[joint]] - back[:, row[parent]]
        assert angles(bone, figure.joints[:, joint] - figure.joints[:, parent]).max() < 1
    assert clip.fps == 20 and angles(clip.turns()[:, row[15], :, 2], world[:, 15, :, 2]).max() < 1
    recorded = read_clip(path)
    np.testing.assert_allclose(recorded.joints * 100, back[:, row], atol=1e-3)
    assert (recorded.fps, recorded.caption) == (20, "a person walks")
    np.testing.assert_array_equal(read_clip(path / f"00-walk{SUFFIX}").joints, recorded.joints)
    weights = [c for c in gltf.json["animations"][0]["channels"] if c["target"]["path"] == "weights"]
    keys = gltf.values(gltf.json["animations"][0]["samplers"][weights[0]["sampler"]]["output"]).reshape(40, 2)
    assert keys[-1, 0] == pytest.approx(0.5 if maker == "vrm0" else 1.0, abs=0.01) and keys[0, 0] == 0
    messages = validated(path)["issues"]["messages"]
    assert [one for one in messages if one["severity"] < 1] == []


def test_knees_stay_as_bent_on_larger_feet() -> None:
    rotations = np.tile(np.eye(3), (20, 52, 1, 1))
    for joint, bent in ((1, -12), (2, -12), (4, 24), (5, 24), (7, -12), (8, -12)):
        rotations[:, joint] = Rotation.from_euler("x", bent, degrees=True).as_matrix()
    figure = RigidMotion.posed(OURS, rotations, np.zeros((20, 3)), np.zeros((20, 52, 3)))
    larger = OURS.offsets * np.where([["_foot" in name] for name in OURS.joints], 2.0, 1.0)
    one, other = figure.joints, on_bones(figure, larger).joints
    for joint in (4, 7):
        assert angles(one[:, joint] - one[:, joint - 3], other[:, joint] - other[:, joint - 3]).max() < 1


def played_at_rest(gltf: Gltf) -> tuple[Floats, Floats]:
    worlds = gltf.worlds()[None]
    size = np.linalg.norm(worlds[..., :3, :3], axis=-2, keepdims=True)
    return worlds[..., :3, 3], worlds[..., :3, :3] / size


def test_names_of_ones_own(tmp_path: Path) -> None:
    nodes = character(tmp_path / "hero.glb", "mixamo")
    data = Gltf.read(tmp_path / "hero.glb")
    for number, node in enumerate(data.json["nodes"]):
        node["name"] = f"bone {number}"
    data.json["buffers"].append({"byteLength": 8})  # as packed files have
    data.write(tmp_path / "odd.glb")
    assert Gltf.read(tmp_path / "odd.glb").json["buffers"][1:] == [{"byteLength": 8}]
    data.json["buffers"][0]["uri"] = "other.bin"
    with pytest.raises(UserError, match=r"another file; export it as one \.glb"):
        data.write(tmp_path / "other.glb")
    with pytest.raises(UserError, match=r"no node for pelvis, head.* and more: name them in a JSON file"):
        Rig.read(tmp_path / "odd.glb")
    (tmp_path / "map.json").write_text(json.dumps({joint: f"bone {node}" for joint, node in nodes.items()}))
    assert Rig.read(tmp_path / "odd.glb", tmp_path / "map.json").nodes == nodes
    (tmp_path / "map.json").write_text('{"pelvis": "bone 1000"}')
    with pytest.raises(UserError, match=r"pelvis: .* has no single node 'bone 1000'"):
        Rig.read(tmp_path / "odd.glb", tmp_path / "map.json")
    with pytest.raises(UserError, match="what --format rig is made by"):
        figure_options({"rig": "x.vrm"}, ["npz"])
    assert set(default_formats(["rig"])) - set(default_formats()) == {"rig", "rig-page"}
    assert figure_options({"rig": "x.vrm"}, ["rig-page"]).more == {"rig": "x.vrm"}
    with pytest.raises(UserError, match=r"odd\.glb: no node for pelvis"):
        read_clip(tmp_path / "odd.glb")
    with pytest.raises(UserError, match=r"hero\.glb: a character without an animation"):
        read_clip(tmp_path / "hero.glb")


@pytest.mark.browser
def test_the_page_draws_the_character(tmp_path: Path, motion: GeneratedMotion, browser: Any) -> None:
    character(tmp_path / "hero.glb", "rigify")
    options = figure_options({"rig": str(tmp_path / "hero.glb")}, ["rig-page"])
    [path] = write_motions(tmp_path / "out", [motion] * 2, ["rig-page"], title="<b>", figure=options)
    page, trouble = browser.new_page(), []
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.goto(path.as_uri())
    page.locator("option").nth(1).wait_for(state="attached", timeout=60_000)
    page.locator("[data-rig=clock]", has_text="/ 1.95 s").wait_for(timeout=60_000)
    assert page.evaluate("window.drawn") == 1 and page.inner_text("h1") == "<b>" and not trouble


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d["nodes"][1].update(children=[0]), "circle|two others"),
        (lambda d: d["nodes"][1].update(children=[999]), "two others, or is none"),
        (lambda d: d.update(nodes=[]), "0 nodes"),
        (lambda d: d.update(nodes=3), "not a glTF scene"),
        (lambda d: d["nodes"][2].update(translation=["a", 0, 0]), "no place"),
        (lambda d: d.pop("nodes"), "nodes"),
    ],
)
def test_broken_characters_are_refused_in_a_sentence(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], said: str
) -> None:
    character(tmp_path / "hero.glb", "mixamo")
    gltf = Gltf.read(tmp_path / "hero.glb")
    change(gltf.json)
    write(tmp_path / "broken.glb", gltf.json, bytes(gltf.blob))
    with pytest.raises(UserError, match=said):
        Rig.read(tmp_path / "broken.glb")
    whole = (tmp_path / "hero.glb").read_bytes()
    for cut in (0, 11, 19, 40, len(whole) - 5):
        (tmp_path / "cut.glb").write_bytes(whole[:cut])
        with pytest.raises(UserError):
            Rig.read(tmp_path / "cut.glb")


def test_a_vrm_animation_holds_the_motion(tmp_path: Path, motion: GeneratedMotion) -> None:
    [path] = write_motions(tmp_path, [motion], ["vrma"], title="")
    gltf = Gltf.read(path)
    places, _ = played(gltf)
    about = gltf.json["extensions"]["VRMC_vrm_animation"]
    bones = {HUMANOID[bone]: place["node"] for bone, place in about["humanoid"]["humanBones"].items()}
    assert set(bones) == set(OURS.joints) - {"spine3"} and about["specVersion"] == "1.0"
    figure = motion.figure
    assert figure is not None
    for joint, parent in LIMBS:
        bone = places[:, bones[OURS.joints[joint]]] - places[:, bones[OURS.joints[parent]]]
        assert angles(bone, figure.joints[:, joint] - figure.joints[:, parent]).max() < 1
    happy = about["expressions"]["preset"]["happy"]["node"]
    assert places[-1, happy, 0] == pytest.approx(1, abs=0.01) and len(about["expressions"]["custom"]) == 52
    assert [one for one in validated(path)["issues"]["messages"] if one["severity"] < 2] == []


PLAY = """
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { VRMLoaderPlugin } from '@pixiv/three-vrm';
import { VRMAnimationLoaderPlugin, createVRMAnimationClip } from '@pixiv/three-vrm-animation';
const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
loader.register((parser) => new VRMAnimationLoaderPlugin(parser));
const vrm = (await loader.loadAsync('hero.vrm')).userData.vrm;
const clip = createVRMAnimationClip((await loader.loadAsync('motion.vrma')).userData.vrmAnimations[0], vrm);
const mixer = new THREE.AnimationMixer(vrm.scene);
mixer.clipAction(clip).play();
mixer.setTime(1.0);
vrm.update(0);
vrm.scene.updateMatrixWorld(true);
const node = (bone) => vrm.humanoid.getRawBoneNode(bone);
const place = (bone) => node(bone).getWorldPosition(new THREE.Vector3()).toArray();
const names = ['leftUpperArm', 'leftLowerArm', 'leftHand', 'rightUpperLeg', 'rightLowerLeg', 'rightFoot'];
window.places = Object.fromEntries(names.map((name) => [name, place(name)]));
window.happy = vrm.expressionManager?.getValue('happy');
"""


@pytest.fixture(scope="module")
def browser_arguments() -> list[str]:
    return ["--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]


@pytest.mark.browser
@pytest.mark.parametrize("maker", ["vrm0", "vrm1"])
def test_three_vrm_plays_it(tmp_path: Path, motion: GeneratedMotion, maker: str, browser: Any) -> None:
    modules = Path(os.environ.get("MOTIONLOOM_NODE_MODULES", ""))
    if not (modules / "@pixiv/three-vrm-animation").is_dir():
        pytest.skip("MOTIONLOOM_NODE_MODULES names no folder with three and @pixiv/three-vrm-animation")
    character(tmp_path / "hero.vrm", maker, lacks=("spine3",) if maker == "vrm1" else ())
    motion.save(tmp_path / "motion.vrma")
    folders = {"three": "three/build/three.module.js", "three/addons/": "three/examples/jsm/"}
    for name in ("@pixiv/three-vrm", "@pixiv/three-vrm-animation"):
        folders[name] = f"{name}/lib/{name[7:]}.module.js"
    uris = {name: (modules / place).as_uri() + "/" * name.endswith("/") for name, place in folders.items()}
    places = json.dumps({"imports": uris})
    page = f'<script type="importmap">{places}</script><script type="module">{PLAY}</script>'
    (tmp_path / "page.html").write_text(page)
    tab = browser.new_page()
    tab.goto((tmp_path / "page.html").as_uri())
    tab.wait_for_function("window.places", timeout=60_000)
    seen, happy = tab.evaluate("[window.places, window.happy]")
    front = np.diag([-1.0, 1.0, -1.0]) if maker == "vrm0" else np.eye(3)
    figure = motion.figure
    assert figure is not None
    for upper, lower in (
        ("leftUpperArm", "leftLowerArm"),
        ("leftLowerArm", "leftHand"),
        ("rightUpperLeg", "rightLowerLeg"),
        ("rightLowerLeg", "rightFoot"),
    ):
        bone = front @ (np.array(seen[lower]) - seen[upper])
        ours = [figure.joints[20, OURS.index(HUMANOID[name])] for name in (lower, upper)]
        assert angles(bone, ours[0] - ours[1]) < 1, lower
    assert happy == pytest.approx(20 / 39, abs=0.02)
