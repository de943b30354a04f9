"""Characters as makers of the field name and pose them, written by this file alone."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.rigid import with_offsets
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.rigs.names import HUMANOID
from motionloom.pipeline.rigs.vrma import t_pose

OURS = Skeleton.named("smplx52")
_MIXAMO = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck",
    "head": "Head", "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder",
    "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
}  # fmt: skip
_RIGIFY = {
    "pelvis": "spine", "spine1": "spine.001", "spine2": "spine.002", "spine3": "spine.003",
    "neck": "spine.004", "head": "spine.006", "hip": "thigh", "knee": "shin", "ankle": "foot", "foot": "toe",
    "collar": "shoulder", "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand",
}  # fmt: skip
_UNREAL = {
    "pelvis": "pelvis", "spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03", "neck": "neck_01",
    "head": "head", "hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "ball", "collar": "clavicle",
    "shoulder": "upperarm", "elbow": "lowerarm", "wrist": "hand",
}  # fmt: skip


def named(maker: str, joint: str) -> str:
    """A maker's word for one of our joints."""
    side, _, word = joint.partition("_") if joint.startswith(("left", "right")) else ("", "", joint)
    finger, number = word[:-1], word[-1]
    is_finger = finger in ("index", "middle", "pinky", "ring", "thumb")
    if maker == "mixamo":
        word = f"Hand{finger.title()}{number}" if is_finger else _MIXAMO[word]
        return f"mixamorig:{side.title()}{word}"
    if maker == "rigify":
        word = f"{'thumb' if finger == 'thumb' else 'f_' + finger}.0{number}" if is_finger else _RIGIFY[word]
        return f"DEF-{word}" + (f".{side[0].upper()}" if side else "")
    if maker == "unreal":
        word = f"{finger}_0{number}" if is_finger else _UNREAL[word]
        return word + (f"_{side[0]}" if side else "")
    return {ours: bone for bone, ours in HUMANOID.items()}[joint]


def character(
    path: Path, maker: str, *, lacks: tuple[str, ...] = (), scale: float = 1.0, seed: int = 0
) -> dict[str, int]:
    """Write a character of 1.15 our size, rest axes at random, a triangle for its skin; returns its nodes.

    `maker` vrm0 looks along -Z, unreal lies on its back below a root that raises it and hangs its arms,
    mixamo is in centimetres below a node of scale 0.01.
    """
    rng = np.random.default_rng(seed)
    places = 1.15 * with_offsets(OURS, t_pose(OURS)).rest_joints + [0.0, 1.05, 0.0]
    if maker == "unreal":
        for side, sign in (("left", -1), ("right", 1)):
            root = places[OURS.index(f"{side}_shoulder")].copy()
            hang = Rotation.from_euler("z", 40 * sign, degrees=True)
            below = [
                j
                for j, name in enumerate(OURS.joints)
                if name.startswith(side) and (j > 21 or name[-5:] in ("elbow", "wrist"))
            ]
            places[below] = root + hang.apply(places[below] - root)
    if maker == "vrm0":
        places = places * [-1.0, 1.0, -1.0]
    turns = Rotation.random(52, rng=rng).as_matrix() if maker != "vrm0" else np.tile(np.eye(3), (52, 1, 1))
    lying = Rotation.from_euler("x", -90, degrees=True)  # Z up, raised again by the root
    frame = lying.as_matrix() if maker == "unreal" else np.eye(3)
    unit = 0.01 if maker == "mixamo" else 1.0
    raised = Rotation.from_matrix(frame).as_quat().tolist()
    nodes: list[dict[str, Any]] = [{"name": "root", "rotation": raised, "scale": [unit] * 3}]
    kept = [joint for joint, name in enumerate(OURS.joints) if name not in lacks]
    row = {joint: number for number, joint in enumerate(kept, 1)}
    out: dict[str, int] = {}
    for joint in kept:
        parent = OURS.parents[joint]
        while parent >= 0 and parent not in row:
            parent = OURS.parents[parent]
        above_turn = turns[parent] if parent >= 0 else frame
        above = places[parent] if parent >= 0 else np.zeros(3)
        local = above_turn.T @ turns[joint]
        nodes.append({
            "name": named(maker, OURS.joints[joint]),
            "translation": (above_turn.T @ (places[joint] - above) / unit).tolist(),
            "rotation": Rotation.from_matrix(local).as_quat().tolist(),
        })  # fmt: skip
        nodes[row[parent] if parent >= 0 else 0].setdefault("children", []).append(row[joint])
        out[OURS.joints[joint]] = row[joint]
    low = places[:, 1].min() - 0.03
    blob = np.array(
        [[0, low, 0], [0.1, 1, 0], [0, 1, 0.1], *np.zeros((3, 3)), [0, 0.1, 0], [0, 0, 0], [0, 0, 0]], "<f4"
    )
    nodes.append({"name": "skin", "mesh": 0})
    accessors = [
        {"bufferView": 0, "byteOffset": 36 * n, "componentType": 5126, "count": 3, "type": "VEC3",
         "min": part.min(axis=0).tolist(), "max": part.max(axis=0).tolist()}
        for n, part in ((0, blob[:3]), (2, blob[6:]))
    ]  # fmt: skip
    primitive = {"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}, {"POSITION": 1}]}
    mesh = {"primitives": [primitive], "extras": {"targetNames": ["mouthSmile", "Blink"]}}
    data: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, len(nodes) - 1]}], "nodes": nodes,
        "meshes": [mesh], "accessors": accessors, "buffers": [{"byteLength": blob.nbytes}],
        "bufferViews": [{"buffer": 0, "byteLength": blob.nbytes, "byteStride": 12}],
    }  # fmt: skip
    bones = {named("vrm", joint): {"node": node} for joint, node in out.items()}
    bind = {"node": len(nodes) - 1, "index": 0, "weight": 1.0}
    meta = {"name": "made", "authors": ["a test"], "licenseUrl": "https://vrm.dev/licenses/1.0/"}
    if maker == "vrm1":
        mesh.pop("extras")
        about = {"specVersion": "1.0", "meta": meta, "humanoid": {"humanBones": bones}}
        data["extensions"] = {
            "VRMC_vrm": about | {"expressions": {"preset": {"happy": {"morphTargetBinds": [bind]}}}}
        }
        data["extensionsUsed"] = ["VRMC_vrm"]
    if maker == "vrm0":
        old = [
            {
                "bone": bone.replace("ThumbProximal", "ThumbIntermediate").replace("Metacarpal", "Proximal"),
                **place,
            }
            for bone, place in bones.items()
        ]
        groups = [{"name": "Joy", "presetName": "joy", "binds": [{"mesh": 0, "index": 0, "weight": 50}]}]
        about = {"specVersion": "0.0", "meta": {"title": "made"}, "materialProperties": []}
        about |= {"humanoid": {"humanBones": old}, "blendShapeMaster": {"blendShapeGroups": groups}}
        data["extensions"] = {"VRM": about}
        data["extensionsUsed"] = ["VRM"]
    write(path, data, blob.tobytes())
    return out


def write(path: Path, data: dict[str, Any], blob: bytes) -> None:
    text = json.dumps(data).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
