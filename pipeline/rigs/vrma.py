"""The format `vrma`: VRM animation 1.0, which any VRM character plays: joints, hips, expressions, gaze."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.retarget import on_bones
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.inference.files.writers import Outputs
from motionloom.pipeline.render.body.face import ARKIT
from motionloom.pipeline.render.body.mesh import body_for
from motionloom.pipeline.rigs.faces import face_values
from motionloom.pipeline.rigs.gltf import Gltf
from motionloom.pipeline.rigs.names import HUMANOID, PRESETS

_OURS = {joint: bone for bone, joint in HUMANOID.items()} | {"spine3": "chest"}
_EYES = (0.0, 0.06, 0.0)
"""From the head to between the eyes, metres; players that follow the gaze start from there."""


def t_pose(skeleton: Skeleton) -> NDArray[np.float64]:
    """Offsets [N, 3] of a skeleton in VRM's T-pose: limbs and fingers but thumbs straight along the axes."""
    out = skeleton.offsets.copy()
    for joint, name in enumerate(skeleton.joints):
        parent = skeleton.joints[skeleton.parents[joint]]
        side = np.array([1.0 if name.startswith("left") else -1.0, 0.0, 0.0])
        length = np.linalg.norm(out[joint])
        if name.endswith(("knee", "ankle")):
            out[joint] = np.array([0.0, -float(length), 0.0])
            continue
        finger = joint >= BODY_JOINTS and "thumb" not in name and parent[-1] in "12"
        if finger or name.endswith(("elbow", "wrist")):
            out[joint] = side * length
    return out


def write_vrma(path: Path, outputs: Outputs) -> None:
    """The motion of one clip."""
    [clip] = outputs.clips
    worn = on_bones(clip.shown.figure, t_pose(clip.shown.figure.skeleton))
    skeleton = worn.skeleton
    frames = len(worn.root)
    lift = -float(body_for(skeleton).vertices[:, 1].min())
    # Players drop what a character has no bone for, and many have no upper chest: the chest takes its turns.
    chest = skeleton.index("spine2")
    high = skeleton.index("spine3")
    parents = list(skeleton.parents)
    offsets = skeleton.offsets + np.array([[0.0, lift, 0.0]] + [[0.0] * 3] * (len(skeleton) - 1))
    rotations = worn.rotations.copy()
    rotations[:, high] = rotations[:, chest] @ rotations[:, high]
    offsets[[child for child, parent in enumerate(parents) if parent == high]] += offsets[high]
    offsets[high] = offsets[chest]
    parents[high] = parents[chest]
    kept = [joint for joint in range(len(skeleton)) if joint != chest]
    nodes: list[dict[str, Any]] = []
    for joint in kept:
        children = [row for row, child in enumerate(kept) if parents[child] == joint]
        nodes.append({"name": _OURS[skeleton.joints[joint]], "translation": offsets[joint].tolist()})
        if children:
            nodes[-1]["children"] = children
    humanoid = {"humanBones": {node["name"]: {"node": row} for row, node in enumerate(nodes)}}
    quaternions = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().reshape(frames, -1, 4)
    tracks = {(row, "rotation"): quaternions[:, joint] for row, joint in enumerate(kept)}
    # At rest the soles are on the floor; in the motion they are where the lowest joint of a foot is.
    feet = [skeleton.index(f"{side}_foot") for side in ("left", "right")]
    sole = lift + float(skeleton.rest_joints[feet, 1].min())
    low = float(worn.joints[:, feet, 1].min())
    tracks[0, "translation"] = worn.root + np.array([0.0, sole - low, 0.0])
    extension: dict[str, Any] = {"specVersion": "1.0", "humanoid": humanoid}
    values = face_values(clip)
    groups = {"preset": PRESETS, "custom": {name: name for name in ARKIT}}
    for group, names in groups.items() if values else ():
        for name, ours in names.items():
            extension.setdefault("expressions", {}).setdefault(group, {})[name] = {"node": len(nodes)}
            tracks[len(nodes), "translation"] = np.pad(values[ours][:, None], ((0, 0), (0, 2)))
            nodes.append({"name": name})
    extension["lookAt"] = {"node": len(nodes), "offsetFromHeadBone": list(_EYES)}
    tracks[len(nodes), "rotation"] = np.array([[0.0, 0.0, 0.0, 1.0]] * frames)
    nodes.append({"name": "lookAt"})
    roots = [0, *range(len(kept), len(nodes))]
    scene = {
        "asset": {"version": "2.0", "generator": "motionloom"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        "extensionsUsed": ["VRMC_vrm_animation"],
        "extensions": {"VRMC_vrm_animation": extension},
    }
    out = Gltf(str(path), scene, bytearray())
    out.animate(clip.name, clip.shown.fps, tracks)
    out.write(path)
