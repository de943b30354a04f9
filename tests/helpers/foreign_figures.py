"""BVH files as the tools of the field write them: their names, trees, extra joints, units and axes.

Every joint of a foreign figure sits on a place of our own rest pose, so which joint stands for which of ours
is known without a look at its name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.skeleton import Skeleton

OURS = Skeleton.named("smplx52")
UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "inch": 1 / 0.0254}
FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")


@dataclass(frozen=True)
class Foreign:
    """One tool's figure. Joints are `NAME@PLACE`; `{}` is the word for the side; places have none."""

    tool: str
    above: tuple[str, ...]
    """Names above the pelvis, on the floor."""
    trunk: tuple[str, ...]
    """From the pelvis up to where the arms branch."""
    neck: tuple[str, ...]
    leg: tuple[str, ...]
    arm: tuple[str, ...]
    sides: tuple[str, str] = ("Left", "Right")
    fingers: Callable[[str, str, int], str] | None = None
    """(side word, finger, number from 1) -> name."""
    finger_joints: int = 3
    in_palm: bool = False
    """Whether fingers (not thumbs) begin with a bone in the palm."""
    hand_end: str = ""
    """A joint after the last of a finger, for example `{}End`."""
    means: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Of our joints that no place gives: the sources that a person would choose."""
    twists: tuple[str, ...] = ()
    """Side branches of the elbow."""


def _number(word: str) -> Callable[[str, str, int], str]:
    return lambda side, finger, n: word.format(side, finger=finger, low=finger.lower(), n=n)


FOREIGN = (
    Foreign(
        "Mixamo",
        (),
        (
            "mixamorig:Hips@pelvis",
            "mixamorig:Spine@spine1",
            "mixamorig:Spine1@spine2",
            "mixamorig:Spine2@spine3",
        ),
        ("mixamorig:Neck@neck", "mixamorig:Head@head", "mixamorig:HeadTop_End@top"),
        tuple(
            f"mixamorig:{{}}{n}"
            for n in ("UpLeg@hip", "Leg@knee", "Foot@ankle", "ToeBase@foot", "Toe_End@toe")
        ),
        tuple(
            f"mixamorig:{{}}{n}" for n in ("Shoulder@collar", "Arm@shoulder", "ForeArm@elbow", "Hand@wrist")
        ),
        fingers=_number("mixamorig:{}Hand{finger}{n}"),
        finger_joints=4,
    ),
    Foreign(
        "CMU",
        (),
        ("Hips@pelvis", "LowerBack@pelvis", "Spine@spine1", "Spine1@spine3"),
        ("Neck@spine3", "Neck1@neck", "Head@head"),
        ("{0[0]}HipJoint@pelvis", "{}UpLeg@hip", "{}Leg@knee", "{}Foot@ankle", "{}ToeBase@foot"),
        ("{}Shoulder@spine3", "{}Arm@shoulder", "{}ForeArm@elbow", "{}Hand@wrist", "{}FingerBase@middle1"),
        means={
            "spine1": ("Hips", "Spine"),
            "spine2": ("Spine",),
            "spine3": ("Spine1",),
            "left_collar": ("LeftShoulder",),
            "right_collar": ("RightShoulder",),
        },
    ),
    Foreign(
        "LAFAN1",
        (),
        ("Hips@pelvis", "Spine@spine1", "Spine1@spine2", "Spine2@spine3"),
        ("Neck@neck", "Head@head"),
        ("{}UpLeg@hip", "{}Leg@knee", "{}Foot@ankle", "{}Toe@foot"),
        ("{}Shoulder@collar", "{}Arm@shoulder", "{}ForeArm@elbow", "{}Hand@wrist"),
    ),
    Foreign(
        "Rokoko",
        ("root",),
        ("Hips@pelvis", "Spine1@spine1", "Spine2@spine2", "Spine3@a1", "Spine4@spine3"),
        ("Neck@neck", "Head@head"),
        ("{}Thigh@hip", "{}Shin@knee", "{}Foot@ankle", "{}Toe@foot", "{}ToeTip@toe"),
        ("{}Shoulder@collar", "{}Arm@shoulder", "{}ForeArm@elbow", "{}Hand@wrist"),
        fingers=lambda side, finger, n: (
            f"{side}Finger{FINGERS.index(finger) + 1}"
            + (
                ("Metacarpal", "Proximal", "Distal")
                if finger == "Thumb"
                else ("Proximal", "Medial", "Distal")
            )[n - 1]
        ),
        hand_end="{}Tip",
        means={"spine2": ("Spine2", "Spine3")},
    ),
    Foreign(
        "Xsens MVN",
        (),
        ("Hips@pelvis", "Chest@spine1", "Chest2@spine2", "Chest3@a1", "Chest4@spine3"),
        ("Neck@neck", "Head@head"),
        ("{}Hip@hip", "{}Knee@knee", "{}Ankle@ankle", "{}Toe@foot"),
        ("{}Collar@collar", "{}Shoulder@shoulder", "{}Elbow@elbow", "{}Wrist@wrist"),
        means={"spine2": ("Chest2", "Chest3")},
    ),
    Foreign(
        "Rigify",
        ("root",),
        ("DEF-spine@pelvis", "DEF-spine.001@spine1", "DEF-spine.002@spine2", "DEF-spine.003@spine3"),
        ("DEF-spine.004@neck", "DEF-spine.005@a2", "DEF-spine.006@head"),
        (
            "DEF-pelvis.{}@a3",
            "DEF-thigh.{}@hip",
            "DEF-thigh.{}.001@a4",
            "DEF-shin.{}@knee",
            "DEF-shin.{}.001@a5",
            "DEF-foot.{}@ankle",
            "DEF-toe.{}@foot",
        ),
        (
            "DEF-shoulder.{}@collar",
            "DEF-upper_arm.{}@shoulder",
            "DEF-upper_arm.{}.001@a6",
            "DEF-forearm.{}@elbow",
            "DEF-forearm.{}.001@a7",
            "DEF-hand.{}@wrist",
        ),
        sides=("L", "R"),
        fingers=lambda side, finger, n: (
            f"DEF-{'' if finger == 'Thumb' else 'f_'}{finger.lower()}.{n:02}.{side}"
        ),
    ),
    Foreign(
        "SMPL",
        (),
        ("Pelvis@pelvis", "Spine1@spine1", "Spine2@spine2", "Spine3@spine3"),
        ("Neck@neck", "Head@head"),
        ("{}_Hip@hip", "{}_Knee@knee", "{}_Ankle@ankle", "{}_Foot@foot"),
        ("{}_Collar@collar", "{}_Shoulder@shoulder", "{}_Elbow@elbow", "{}_Wrist@wrist", "{}_Hand@middle1"),
        sides=("L", "R"),
    ),
    Foreign(
        "SMPL-X",
        (),
        ("pelvis@pelvis", "spine1@spine1", "spine2@spine2", "spine3@spine3"),
        ("neck@neck", "head@head", "jaw@jaw"),
        ("{}_hip@hip", "{}_knee@knee", "{}_ankle@ankle", "{}_foot@foot"),
        ("{}_collar@collar", "{}_shoulder@shoulder", "{}_elbow@elbow", "{}_wrist@wrist"),
        sides=("left", "right"),
        fingers=_number("{}_{low}{n}"),
    ),
    Foreign(
        "BONES, SOMA 77",
        ("Root",),
        ("Hips@pelvis", "Spine1@spine1", "Spine2@spine2", "Chest@spine3"),
        ("Neck1@neck", "Neck2@a2", "Head@head", "HeadEnd@top"),
        ("{}Leg@hip", "{}Shin@knee", "{}Foot@ankle", "{}ToeBase@foot", "{}ToeEnd@toe"),
        ("{}Shoulder@collar", "{}Arm@shoulder", "{}ForeArm@elbow", "{}Hand@wrist"),
        fingers=_number("{}Hand{finger}{n}"),
        finger_joints=4,
        in_palm=True,
        hand_end="{}End",
    ),
    Foreign(
        "Unreal mannequin",
        ("root",),
        (
            "pelvis@pelvis",
            "spine_01@spine1",
            "spine_02@b1",
            "spine_03@spine2",
            "spine_04@a1",
            "spine_05@spine3",
        ),
        ("neck_01@neck", "neck_02@a2", "head@head"),
        ("thigh_{}@hip", "calf_{}@knee", "foot_{}@ankle", "ball_{}@foot"),
        ("clavicle_{}@collar", "upperarm_{}@shoulder", "lowerarm_{}@elbow", "hand_{}@wrist"),
        sides=("l", "r"),
        fingers=lambda side, finger, n: f"{finger.lower()}_{n:02}_{side}",
        twists=("lowerarm_twist_01_{}", "lowerarm_twist_02_{}"),
    ),
    Foreign(
        "Bandai-Namco",
        ("joint_Root",),
        ("Hips@pelvis", "Spine@spine2", "Chest@spine3"),
        ("Neck@neck", "Head@head"),
        ("UpperLeg_{}@hip", "LowerLeg_{}@knee", "Foot_{}@ankle", "Toes_{}@foot"),
        ("Shoulder_{}@collar", "UpperArm_{}@shoulder", "LowerArm_{}@elbow", "Hand_{}@wrist"),
        sides=("L", "R"),
        means={"spine1": ("Hips", "Spine"), "spine2": ("Spine",), "spine3": ("Chest",)},
    ),
)

OTHERS = (
    Foreign(
        "3ds Max Biped",
        ("Bip01",),
        (
            "Bip01 Pelvis@pelvis",
            "Bip01 Spine@spine1",
            "Bip01 Spine1@spine2",
            "Bip01 Spine2@spine3",
            "Bip01 Neck@neck",
        ),
        ("Bip01 Head@head", "Bip01 HeadNub@top"),
        tuple(
            f"Bip01 {{}} {n}" for n in ("Thigh@hip", "Calf@knee", "Foot@ankle", "Toe0@foot", "Toe0Nub@toe")
        ),
        tuple(
            f"Bip01 {{}} {n}" for n in ("Clavicle@collar", "UpperArm@shoulder", "Forearm@elbow", "Hand@wrist")
        ),
        sides=("L", "R"),
    ),
    Foreign(
        "Kinect",
        (),
        ("SpineBase@pelvis", "SpineMid@spine2", "SpineShoulder@spine3"),
        ("Neck@neck", "Head@head"),
        ("Hip{}@hip", "Knee{}@knee", "Ankle{}@ankle", "Foot{}@foot"),
        ("Shoulder{}@shoulder", "Elbow{}@elbow", "Wrist{}@wrist", "Hand{}@middle1"),
        means={
            "spine1": ("SpineBase", "SpineMid"),
            "left_collar": ("SpineShoulder", "Neck", "ShoulderLeft"),
            "right_collar": ("SpineShoulder", "Neck", "ShoulderRight"),
        },
    ),
    Foreign(
        "CMU (ASF)",
        (),
        ("root@pelvis", "lowerback@spine1", "upperback@spine2", "thorax@spine3"),
        ("lowerneck@neck", "upperneck@a2", "head@head"),
        ("{}hipjoint@a3", "{}femur@hip", "{}tibia@knee", "{}foot@ankle", "{}toes@foot"),
        ("{}clavicle@collar", "{}humerus@shoulder", "{}radius@elbow", "{}wrist@wrist", "{}hand@middle1"),
        sides=("l", "r"),
    ),
    Foreign(
        "Xsens MVN (segments)",
        (),
        ("Pelvis@pelvis", "L5@spine1", "L3@spine2", "T12@a1", "T8@spine3"),
        ("Neck@neck", "Head@head"),
        ("{}UpperLeg@hip", "{}LowerLeg@knee", "{}Foot@ankle", "{}Toe@foot"),
        ("{}Shoulder@collar", "{}UpperArm@shoulder", "{}Forearm@elbow", "{}Hand@wrist"),
        means={"spine2": ("L3", "T12")},
    ),
    Foreign(
        "Unity, VRM",
        (),
        ("hips@pelvis", "spine@spine1", "chest@spine2", "upperChest@spine3"),
        ("neck@neck", "head@head", "jaw@jaw"),
        ("{}UpperLeg@hip", "{}LowerLeg@knee", "{}Foot@ankle", "{}Toes@foot"),
        ("{}Shoulder@collar", "{}UpperArm@shoulder", "{}LowerArm@elbow", "{}Hand@wrist"),
        sides=("left", "right"),
        fingers=lambda side, finger, n: (
            f"{side}{ {'Pinky': 'Little'}.get(finger, finger) }"
            + (
                ("Metacarpal", "Proximal", "Distal")
                if finger == "Thumb"
                else ("Proximal", "Intermediate", "Distal")
            )[n - 1]
        ),
    ),
    Foreign(
        "DAZ, Poser",
        (),
        ("hip@pelvis", "abdomen@spine2", "chest@spine3"),
        ("neck@neck", "head@head", "leftEye@jaw"),
        ("{}Thigh@hip", "{}Shin@knee", "{}Foot@ankle", "{}Toe@foot"),
        ("{}Collar@collar", "{}Shldr@shoulder", "{}ForeArm@elbow", "{}Hand@wrist"),
        sides=("l", "r"),
        means={"spine1": ("hip", "abdomen")},
    ),
)


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
    assert spec.fingers is not None
    wrist, knuckle = places[f"{side}wrist"], places[f"{side}{finger.lower()}1"]
    points = [places[f"{side}{finger.lower()}{n}"] for n in (1, 2, 3)]
    kept = [f"{side}{finger.lower()}{n}" for n in (1, 2, 3)]
    if spec.in_palm and finger != "Thumb":
        points, kept = [wrist + 0.3 * (knuckle - wrist), *points], ["", *kept]
    tip = points[-1] + 0.8 * (points[-1] - points[-2])
    count = 3 if spec.in_palm and finger == "Thumb" else spec.finger_joints
    points, kept = [*points, tip][:count], [*kept, ""][:count]
    for n, (point, place) in enumerate(zip(points, kept, strict=True), start=1):
        parent = out.add(spec.fingers(word, finger, n), parent, point, place)
    if spec.hand_end:
        base = spec.fingers(word, finger, 1).rstrip("0123456789")
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
    to_file = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "z" else np.eye(3)
    scale = UNITS[unit]
    root = np.stack([0.2 * times[:, 0], np.full(frames, 0.95), 0.8 * times[:, 0]], axis=-1) + points[0]
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
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return world


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
