"""A character, and motions on it.

With `G(t)` the world rotation of our joint, `A` that of our rest pose laid over the character's, `R` the
world rotation of its node at rest and `H` the turn that makes the character look along +Z:

    node(t) = H^-1 G(t) A^-1 H R

Its own bones are measured first and the motion is put on them (`retarget.on_bones`), so that steps are as
long as its legs and feet are on its floor. Rotations are the world's: what a joint that it lacks would turn,
its children turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.retarget import SourceFigure, carried, on_bones, upright_turn, with_hands
from motionloom.datasets.motion.body.rigid import RigidMotion, with_offsets
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.rigs.gltf import Gltf
from motionloom.pipeline.rigs.names import WHOLE, nodes_of

Floats = NDArray[np.float64]

_SAME = 0.02
"""Difference of two places, as a share of the figure, up to which a file stands in its bind pose."""
_SOLE = 0.03
"""Thickness of a sole where no mesh shows it, metres of a grown person."""
_BETWEEN = {
    "spine3": ("pelvis", "head"), "spine1": ("pelvis", "spine3"), "spine2": ("pelvis", "spine3"),
    "neck": ("spine3", "head"), "left_collar": ("spine3", "left_shoulder"),
    "right_collar": ("spine3", "right_shoulder"),
}  # fmt: skip
"""Joints between which one lies that a character lacks."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A character whose joints are known."""

    gltf: Gltf
    nodes: dict[str, int]
    """Our joints -> nodes."""
    ahead: Floats
    """The turn [3, 3] that makes it look along +Z, upright."""
    turns: Floats
    """World rotations of all nodes at rest [N, 3, 3]."""
    skeleton: Skeleton
    """Its bones, as our joints, in metres of a grown person."""
    laid: Floats
    """World rotations of our rest pose laid over its own [J, 3, 3]."""
    unit: float
    """Its lengths in one of these metres."""
    ball: float
    """Height of the balls of its feet above its floor, in its lengths."""

    @staticmethod
    def read(path: Path, own: Path | None = None) -> Rig:
        """The character of a GLB or VRM file; `own` is a JSON file of names."""
        try:
            return Rig._of(Gltf.read(path), path, own)
        except (ArithmeticError, ValueError) as error:
            raise UserError(f"{path}: a character whose bones are none ({error})") from None

    @staticmethod
    def _of(gltf: Gltf, path: Path, own: Path | None) -> Rig:
        rest = _rest_worlds(gltf)
        places = rest[:, :3, 3]
        scales = np.linalg.norm(rest[:, :3, :3], axis=1)
        nodes = nodes_of(gltf, places, own)
        hands = any(joint in nodes for joint in WHOLE.joints[BODY_JOINTS:])
        skeleton = WHOLE if hands else Skeleton.named("smpl22")
        points = {joint: places[node] for joint, node in nodes.items() if joint in skeleton.joints}
        ahead = upright_turn(_filled(points, skeleton), skeleton)
        joints = _filled({joint: ahead @ place for joint, place in points.items()}, skeleton)
        size = _legs(joints, skeleton) / _legs(skeleton.rest_joints, skeleton)
        if not size > 1e-6:
            raise UserError(f"{path}: a character whose legs have no length, or that does not stand at rest")
        known = np.array([joint in nodes for joint in skeleton.joints])
        alone = np.broadcast_to(np.eye(3), (1, len(skeleton), 3, 3))
        posed = carried(SourceFigure(joints[None] / size, alone, known, joints / size), skeleton)
        own_bones = posed.skeleton
        _, laid = forward_kinematics(posed.rotations, posed.root, own_bones.offsets, own_bones.parents)
        balls = joints[[skeleton.index("left_foot"), skeleton.index("right_foot")], 1].mean()
        floor = _floor(gltf, rest, ahead)
        ball = float(balls - floor) if np.isfinite(floor) else _SOLE * size
        if not 0 <= ball < 0.3 * size:
            ball = _SOLE * size
        turns = rest[:, :3, :3] / np.maximum(scales, 1e-12)[:, None]
        return Rig(gltf, nodes, ahead, turns, own_bones, laid[0], size, ball)

    def lacks(self) -> list[str]:
        """Sentences on what it has no joints for."""
        missing = [joint for joint in WHOLE.joints if joint not in self.nodes]
        fingers = [joint for joint in missing if joint in WHOLE.joints[BODY_JOINTS:]]
        body = [joint for joint in missing if joint not in fingers]
        out = []
        if body:
            out.append(f"it has no {', '.join(body)}: the joints below turn in their place")
        if fingers:
            which = "fingers" if len(fingers) == 30 else f"{len(fingers)} of 30 finger joints"
            out.append(f"it has no {which}" if which == "fingers" else f"it lacks {which}")
        return out

    def tracks(self, figure: RigidMotion) -> dict[tuple[int, str], Floats]:
        """Quaternions [T, 4] of its joints and places [T, 3] of its hips, for a motion."""
        worn = on_bones(_of_joints(figure, self.skeleton), self.skeleton.offsets)
        parents = self.skeleton.parents
        _, world = forward_kinematics(worn.rotations, worn.root, self.skeleton.offsets, parents)
        numbered = enumerate(self.skeleton.joints)
        ours = {self.nodes[joint]: number for number, joint in numbered if joint in self.nodes}
        frames = len(worn.root)
        hips = self.nodes["pelvis"]
        turned = np.empty((len(self.gltf.parents), frames, 3, 3))
        tracks: dict[tuple[int, str], Floats] = {}
        for node in self.gltf.in_order():
            parent = self.gltf.parents[node]
            above = turned[parent] if parent >= 0 else np.broadcast_to(np.eye(3), (frames, 3, 3))
            if node not in ours:
                turned[node] = above @ self.gltf.local(node)[1]
                continue
            joint = ours[node]
            turned[node] = self.ahead.T @ world[:, joint] @ self.laid[joint].T @ self.ahead @ self.turns[node]
            tracks[node, "rotation"] = Rotation.from_matrix(above.swapaxes(-1, -2) @ turned[node]).as_quat()
        low = min(worn.joints[:, self.skeleton.index(f"{side}_foot"), 1].min() for side in ("left", "right"))
        place = (worn.root - [0.0, low, 0.0]) * self.unit + [0.0, self.ball, 0.0]
        carrier = self.gltf.worlds()[self.gltf.parents[hips]] if self.gltf.parents[hips] >= 0 else np.eye(4)
        inverse = np.linalg.inv(carrier)
        tracks[hips, "translation"] = place @ self.ahead @ inverse[:3, :3].T + inverse[:3, 3]
        return tracks


def _of_joints(figure: RigidMotion, skeleton: Skeleton) -> RigidMotion:
    """The figure with hands or without, as a skeleton has them."""
    have = len(figure.skeleton)
    want = len(skeleton)
    if have < want:
        return with_hands(figure)
    if have == want:
        return figure
    body = with_offsets(Skeleton.named("smpl22"), figure.skeleton.offsets[:want])
    return RigidMotion(body, figure.rotations[:, :want], figure.root, figure.joints[:, :want], figure.error)


def _rest_worlds(gltf: Gltf) -> Floats:
    """World matrices of the nodes at rest [N, 4, 4]: of the pose that the skin was bound in, where this is
    known and the file stands otherwise.
    """
    worlds = gltf.worlds()
    extensions = gltf.json.get("extensions") or {}
    skins = gltf.json.get("skins") or []
    if "VRM" in extensions or "VRMC_vrm" in extensions or not skins:
        return worlds  # a VRM file stands in T-pose
    try:
        skin = max(skins, key=lambda one: len(one["joints"]))
        joints = [int(joint) for joint in skin["joints"]]
        bound = np.linalg.inv(gltf.values(int(skin["inverseBindMatrices"])).reshape(-1, 4, 4).swapaxes(1, 2))
        if len(bound) != len(joints) or not all(0 <= joint < len(worlds) for joint in joints):
            return worlds
    except (UserError, KeyError, TypeError, ValueError, np.linalg.LinAlgError):
        return worlds
    moves = worlds[joints] @ np.linalg.inv(bound)
    meshes = [n for n, node in enumerate(gltf.json["nodes"]) if node.get("skin") == skins.index(skin)]
    size = max(float(np.ptp(worlds[joints, :3, 3], axis=0).max()), 1e-9)
    moved = (moves[:, :3, :3] @ bound[:, :3, 3, None])[..., 0] + moves[:, :3, 3]
    settled = (moves[0, :3, :3] @ bound[:, :3, 3, None])[..., 0] + moves[0, :3, 3]
    if not meshes or np.abs(moved - settled).max() < _SAME * size:
        return worlds
    out = worlds.copy()
    out[joints] = worlds[meshes[0]] @ bound
    return out


def _filled(points: dict[str, Floats], skeleton: Skeleton) -> Floats:
    """Places of all joints [J, 3]; unknown ones lie between their neighbours, or as in our rest pose."""
    points = dict(points)
    for joint, (above, below) in _BETWEEN.items():
        if joint not in points:
            share = 0.5 if joint != "spine3" else 0.6
            points[joint] = points[above] + share * (points[below] - points[above])
    shin = np.linalg.norm(points["left_knee"] - points["left_ankle"])
    size = shin / np.linalg.norm(skeleton.offsets[skeleton.index("left_ankle")])
    for joint, parent in zip(skeleton.joints[1:], skeleton.parents[1:], strict=True):
        if joint not in points:
            offset = skeleton.offsets[skeleton.index(joint)]
            points[joint] = points[skeleton.joints[parent]] + offset * size
    return np.stack([points[joint] for joint in skeleton.joints])


def _legs(joints: Floats, skeleton: Skeleton) -> float:
    """Height of the hips above the ankles."""
    high, low = (
        joints[[skeleton.index(f"{side}_{name}") for side in ("left", "right")], 1].mean()
        for name in ("hip", "ankle")
    )
    return float(high - low)


def _floor(gltf: Gltf, rest: Floats, ahead: Floats) -> float:
    """The lowest place of the meshes at rest; infinite where there are none."""
    low = np.inf
    if "VRM" in (gltf.json.get("extensions") or {}) or "VRMC_vrm" in (gltf.json.get("extensions") or {}):
        return 0.0
    for number, node in enumerate(gltf.json["nodes"]):
        try:
            for one in gltf.json["meshes"][node["mesh"]]["primitives"]:
                about = gltf.json["accessors"][one["attributes"]["POSITION"]]
                ends = np.array([about["min"], about["max"]], dtype=np.float64).reshape(2, 3)
                corners = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
                seen = corners @ rest[number, :3, :3].T + rest[number, :3, 3]
                low = min(low, float((seen @ ahead.T)[:, 1].min()))
        except (KeyError, TypeError, ValueError, IndexError):
            continue
    return low
