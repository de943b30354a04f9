"""BVH files as the tools of the field write them: their names, trees, extra joints, units and axes.

Every joint of a foreign figure sits on a place of our own rest pose, so which joint stands for which of ours
is known without a look at its name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from foreign_tools import FINGERS, Foreign
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.skeleton import Skeleton

OURS = Skeleton.named("smplx52")
UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "inch": 1 / 0.0254}


@dataclass
class Built:
    """Joints of a foreign figure: names, parents, rest positions in metres (Y up, facing +Z)."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    points: list[NDArray[np.float64]] = field(default_factory=list)
    ours: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """The map that a person would write."""

    def add(self, name: str, parent: int, point: NDArray[np.float64], place: str = "") -> int:
        if place in OURS.joints:
            self.ours.setdefault(place, (name,))
        self.names.append(name)
        self.parents.append(parent)
        self.points.append(point)
        return len(self.names) - 1


def build(spec: Foreign, *, a_pose: bool = False) -> Built:
    """The joints of a figure in T-pose or with hanging arms."""
    places = _places(a_pose)
    out, at = Built(), -1
    for name in spec.above:
        at = out.add(name, at, np.array([0.0, -0.9, 0.0]))

    def chain(parent: int, joints: tuple[str, ...], side: str = "", word: str = "") -> int:
        for joint in joints:
            name, place = joint.format(word).split("@")
            place = place if f"{side}{place}" not in places else f"{side}{place}"
            parent = out.add(name, parent, places[place], place)
        return parent

    pelvis = chain(at, spec.trunk[:1])
    sides = tuple(zip(("left_", "right_"), spec.sides, strict=True))
    for side, word in sides:
        chain(pelvis, spec.leg, side, word)
    chest = chain(pelvis, spec.trunk[1:])
    chain(chest, spec.neck)
    for side, word in sides:
        chain(chest, spec.arm, side, word)
        hands = [name.format(word).split("@")[0] for name in spec.arm if name.endswith("@wrist")]
        wrist = out.names.index(hands[0]) if hands else -1
        for number, twist in enumerate(spec.twists):
            elbow, share = places[f"{side}elbow"], (number + 1) / 3
            point = elbow + share * (places[f"{side}wrist"] - elbow)
            out.add(twist.format(word), out.parents[wrist], point)
        for finger in FINGERS if spec.fingers else ():
            _add_finger(out, spec, wrist, side, word, finger, places)
    out.ours |= spec.means
    return out


def _add_finger(
    out: Built,
    spec: Foreign,
    parent: int,
    side: str,
    word: str,
    finger: str,
    places: dict[str, NDArray[np.float64]],
) -> None:
    wrist, knuckle = places[f"{side}wrist"], places[f"{side}{finger.lower()}1"]
    points = [places[f"{side}{finger.lower()}{n}"] for n in (1, 2, 3)]
    kept = [f"{side}{finger.lower()}{n}" for n in (1, 2, 3)]
    if spec.in_palm and finger != "Thumb":
        points, kept = [wrist + 0.3 * (knuckle - wrist), *points], ["", *kept]
    tip = points[-1] + 0.8 * (points[-1] - points[-2])
    count = 3 if spec.in_palm and finger == "Thumb" else spec.finger_joints
    points, kept = [*points, tip][:count], [*kept, ""][:count]
    for n, (point, place) in enumerate(zip(points, kept, strict=True), start=1):
        parent = out.add(spec.finger(word, finger, n), parent, point, place)
    if spec.hand_end:
        base = spec.finger(word, finger, 1).rstrip("0123456789")
        out.add(spec.hand_end.format(base), parent, points[-1] + 0.5 * (tip - points[-1]) + 0.001)


def _places(a_pose: bool) -> dict[str, NDArray[np.float64]]:
    """Points of a person: our joints, and others that tools have."""
    at = dict(zip(OURS.joints, OURS.rest_joints.copy(), strict=True))
    if a_pose:
        for side, sign in (("left", -1), ("right", 1)):
            turn = Rotation.from_euler("z", sign * 45, degrees=True).as_matrix()
            root = at[f"{side}_shoulder"].copy()
            hand = [n for n in at if n.startswith(side) and ("elbow" in n or "wrist" in n or n[-1] in "123")]
            for name in hand:
                at[name] = root + turn @ (at[name] - root)
    at |= {"top": at["head"] + [0, 0.18, 0.02], "jaw": at["head"] + [0, 0.01, 0.05]}
    at["a1"] = 0.5 * (at["spine2"] + at["spine3"])
    at["b1"] = 0.5 * (at["spine1"] + at["spine2"])
    at["a2"] = 0.5 * (at["neck"] + at["head"])
    for side in ("left_", "right_"):
        pairs = (("a3", "hip", None), ("a4", "hip", "knee"), ("a5", "knee", "ankle"))
        for name, a, b in (*pairs, ("a6", "shoulder", "elbow"), ("a7", "elbow", "wrist")):
            at[side + name] = 0.5 * (at[side + a] + (at[side + b] if b else at["pelvis"]))
        at[side + "toe"] = at[side + "foot"] + [0, -0.01, 0.07]
    return at


def write_figure(
    path: Path,
    built: Built,
    *,
    unit: str = "cm",
    up: str = "y",
    fps: float = 60.0,
    frames: int = 90,
    seed: int = 0,
    twisted: bool = False,
) -> NDArray[np.float64]:
    """Write a clip of a walking, swaying figure; returns the joints [T, N, 3] in metres, Y up.

    `twisted` gives every joint rest axes of its own, as LAFAN1 and Bandai-Namco do: without the rotations of
    a frame, the offsets make no figure.
    """
    rng = np.random.default_rng(seed)
    count, times = len(built.names), np.arange(frames)[:, None] / fps
    points = np.array(built.points)
    swing = 0.12 * np.sin(times[..., None] * rng.uniform(1, 4, (count, 1))) * rng.standard_normal((count, 3))
    local = Rotation.from_rotvec(swing.reshape(-1, 3)).as_matrix().reshape(frames, count, 3, 3)
    axes = (
        Rotation.random(count, rng=rng).as_matrix() if twisted else np.broadcast_to(np.eye(3), (count, 3, 3))
    )
    root = np.stack([0.2 * times[:, 0], np.full(frames, 0.95), 0.8 * times[:, 0]], axis=-1) + points[0]
    text, world = bvh_text(built, local, root, axes, unit=unit, up=up, fps=fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return world


def bvh_text(
    built: Built,
    local: NDArray[np.float64],
    root: NDArray[np.float64],
    axes: NDArray[np.float64],
    *,
    unit: str = "cm",
    up: str = "y",
    fps: float,
) -> tuple[str, NDArray[np.float64]]:
    """A BVH file, and its joints [T, N, 3] in metres, Y up, of local rotations [T, N, 3, 3], places of the
    first joint [T, 3] and rest axes [N, 3, 3].
    """
    frames, count = local.shape[:2]
    points, scale = np.array(built.points), UNITS[unit]
    to_file = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "z" else np.eye(3)
    world, turned = np.empty((frames, count, 3)), np.empty((frames, count, 3, 3))
    offsets, written = np.zeros((count, 3)), np.empty((frames, count, 3, 3))
    for joint, parent in enumerate(built.parents):
        bone = points[joint] - (points[parent] if parent >= 0 else points[0])
        if parent < 0:
            turned[:, joint], world[:, joint] = local[:, joint], root
            written[:, joint] = to_file @ turned[:, joint] @ axes[joint]
            continue
        world[:, joint] = world[:, parent] + turned[:, parent] @ bone
        turned[:, joint] = turned[:, parent] @ local[:, joint]
        offsets[joint] = axes[parent].T @ bone * scale
        written[:, joint] = axes[parent].T @ local[:, joint] @ axes[joint]
    angles = Rotation.from_matrix(written.reshape(-1, 3, 3)).as_euler("ZYX", degrees=True)
    values = np.concatenate([root @ to_file.T * scale, angles.reshape(frames, -1)], axis=1)
    order = _file_order(built.parents)
    columns = [0, 1, 2, *(3 + 3 * joint + axis for joint in order for axis in range(3))]
    lines = [
        "HIERARCHY",
        *_block(built, 0, offsets),
        "MOTION",
        f"Frames: {frames}",
        f"Frame Time: {1 / fps:.9f}",
    ]
    lines += [" ".join(f"{value:.6f}" for value in row) for row in values[:, columns].tolist()]
    return "\n".join(lines) + "\n", world


def _file_order(parents: list[int], joint: int = 0) -> list[int]:
    below = [child for child, parent in enumerate(parents) if parent == joint]
    return [joint, *(j for child in below for j in _file_order(parents, child))]


def _block(built: Built, joint: int, offsets: NDArray[np.float64]) -> list[str]:
    below = [child for child, parent in enumerate(built.parents) if parent == joint]
    channels = "6 Xposition Yposition Zposition Zrotation Yrotation Xrotation"
    body = ["OFFSET " + " ".join(f"{value:.6f}" for value in offsets[joint])]
    body += [f"CHANNELS {'3 Zrotation Yrotation Xrotation' if joint else channels}"]
    body += [line for child in below for line in _block(built, child, offsets)]
    body += [] if below else ["End Site", "{", "OFFSET 0.0 0.0 0.0", "}"]
    return [f"{'JOINT' if joint else 'ROOT'} {built.names[joint]}", "{", *body, "}"]
