"""The shapes of the figure, hung on the rest joints of a skeleton: trunk and limbs, hands, head.

A lay figure, not a likeness: one closed mesh of trunk, sleeves, legs and feet, hands whose forearms reach
into the sleeves, a head whose neck reaches into the collar. Radii are those of an adult of 1.7 m.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from field import Capsule, Field
from numpy.typing import NDArray

from motionloom.datasets.motion.body.rigid import with_offsets
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton

Floats = NDArray[np.float64]

SPREAD = {"index": 48.0, "middle": 14.0, "ring": -16.0, "pinky": -46.0, "thumb": 12.0}
"""By how many degrees each finger is turned away from the next while a hand's surface is made."""
_ROUND = 2 * np.pi * np.arange(16) / 16
HEAD_SIZE = (0.079, 0.112, 0.094)
"""Half width, half height, half depth of the skull in metres."""
_KNUCKLE = {"index": 0.0108, "middle": 0.0112, "ring": 0.0104, "pinky": 0.0092, "thumb": 0.0122}


def trunk_and_limbs(skeleton: Skeleton) -> Field:
    """Everything but hands and head."""
    rest = skeleton.rest_joints
    at = skeleton.index
    out: list[Capsule] = []

    def place(joint: str, *move: float) -> Floats:
        return np.asarray(rest[at(joint)] + np.asarray(move or (0.0, 0.0, 0.0)), dtype=np.float64)

    def add(joint: str, a: Floats, b: Floats, ra: float, rb: float, flat: float = 1.0) -> None:
        out.append(Capsule(at(joint), a, b, ra, rb, flat))

    # The trunk: a column on each side, from the hips over the waist to the chest, and one in the middle.
    for sign in (-1.0, 1.0):
        column = (
            ("pelvis", place("pelvis", sign * 0.072, -0.06, -0.004), 0.096),
            ("pelvis", place("pelvis", sign * 0.062, 0.03, -0.002), 0.09),
            ("spine1", place("spine1", sign * 0.05, 0.03, 0.012), 0.083),
            ("spine2", place("spine2", sign * 0.058, 0.01, 0.012), 0.087),
            ("spine3", place("spine3", sign * 0.07, 0.05, 0.004), 0.094),
            ("spine3", place("spine3", sign * 0.062, 0.13, -0.012), 0.068),
        )
        for (joint, low, r_low), (_, high, r_high) in pairwise(column):
            add(joint, low, high, r_low, r_high, 0.92)
    add("pelvis", place("pelvis", 0.0, -0.04, 0.0), place("spine1"), 0.085, 0.08)
    add("spine1", place("spine1"), place("spine3", 0.0, 0.06, 0.01), 0.08, 0.085)
    add("spine3", place("spine3", 0.0, 0.06, 0.01), place("neck", 0.0, -0.03, 0.004), 0.085, 0.056)
    for side in ("left", "right"):
        sign = 1.0 if side == "left" else -1.0
        shoulder, elbow, wrist = (place(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist"))
        add(f"{side}_collar", place("neck", sign * 0.025, -0.02, 0.0), shoulder, 0.044, 0.05)
        add(f"{side}_shoulder", shoulder, elbow, 0.054, 0.039)
        add(f"{side}_shoulder", shoulder, shoulder + 0.3 * (elbow - shoulder), 0.056, 0.05)
        # The forearm is thickest below the elbow; the sleeve ends before the wrist.
        belly, sleeve = (elbow + share * (wrist - elbow) for share in (0.28, 0.72))
        add(f"{side}_elbow", elbow, belly, 0.038, 0.042)
        add(f"{side}_elbow", belly, sleeve, 0.042, 0.033, 0.92)
        hip, knee, ankle, ball = (place(f"{side}_{name}") for name in ("hip", "knee", "ankle", "foot"))
        add(f"{side}_hip", hip, knee, 0.086, 0.047)
        calf = knee + np.array([0.0, 0.0, -0.014]) + 0.3 * (ankle - knee)
        add(f"{side}_knee", knee, calf, 0.045, 0.05)
        add(f"{side}_knee", calf, ankle, 0.05, 0.035)
        low = ball[1] - 0.012
        heel = np.array([ankle[0], low + 0.008, ankle[2] - 0.03])
        add(f"{side}_ankle", ankle, heel, 0.037, 0.034)
        for across in (-0.018, 0.018):
            move = np.array([across, -0.004, 0.0])
            add(f"{side}_ankle", ankle + _move(0.5 * across, -0.012, 0.02), ball + move, 0.034, 0.026)
            toes = np.array([ball[0] + across * 0.9, low + 0.004, ball[2] + 0.052 - 0.18 * across * sign])
            add(f"{side}_foot", ball + move, toes, 0.026, 0.019)
        add(f"{side}_ankle", heel, ball + _move(0.0, -0.008, 0.0), 0.03, 0.022)
    return Field(out, 0.014)


def hand(skeleton: Skeleton, side: str) -> Field:
    """Palm, fingers and thumb, and the forearm as far as it is inside its sleeve."""
    rest = skeleton.rest_joints
    at = skeleton.index
    wrist = rest[at(f"{side}_wrist")]
    out: list[Capsule] = []
    palm = at(f"{side}_wrist")
    bone = skeleton.offsets[at(f"{side}_wrist")]
    out.append(Capsule(at(f"{side}_elbow"), wrist - 0.26 * bone, wrist - 0.02 * bone, 0.0275, 0.0235, 0.92))
    out.append(Capsule(palm, wrist, wrist + 0.06 * bone, 0.023, 0.021, 0.95))
    for finger in SPREAD:
        first, second, third = (rest[at(f"{side}_{finger}{k}")] for k in (1, 2, 3))
        tip = third + 0.85 * (third - second)
        thick = _KNUCKLE[finger]
        if finger == "thumb":
            out.append(Capsule(palm, wrist + 0.35 * (first - wrist), first, 0.016, 0.0155))
        else:
            out.append(Capsule(palm, wrist + 0.12 * (first - wrist), first, 0.0175, 0.0122))
            out.append(Capsule(palm, wrist + 0.5 * (first - wrist), first, 0.0145, 0.0122))
        for k, (a, b, ra, rb) in enumerate(
            ((first, second, 1.06, 0.98), (second, third, 0.98, 0.92), (third, tip, 0.92, 0.78)), start=1
        ):
            out.append(Capsule(at(f"{side}_{finger}{k}"), a, b, ra * thick, rb * thick))
    return Field(out, 0.0022)


def spread(skeleton: Skeleton) -> tuple[Skeleton, Floats]:
    """The skeleton with fingers apart, and each joint's turn [N, 3, 3] from the rest pose.

    At rest fingers nearly touch: their surface is made where the grid tells them apart, and taken back.
    """
    local = np.tile(np.eye(3), (1, len(skeleton), 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for finger, degrees in SPREAD.items():
            angle = -sign * np.radians(degrees)
            turn = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
            local[0, skeleton.index(f"{side}_{finger}1")] = turn
    places, turns = forward_kinematics(local, np.zeros((1, 3)), skeleton.offsets, skeleton.parents)
    offsets = [
        place - places[0, max(parent, 0)] for place, parent in zip(places[0], skeleton.parents, strict=True)
    ]
    return with_offsets(skeleton, np.array(offsets)), turns[0]


def collar(skeleton: Skeleton) -> Floats:
    """A band along the line where neck and trunk meet, lower in front and behind [rows, around, 3]."""
    foot = skeleton.rest_joints[skeleton.index("neck")]
    line = 0.014 - 0.009 * np.cos(2 * _ROUND)
    profile = [(0.046, -0.004), (0.056, 0.005), (0.06, 0.003), (0.0635, -0.004), (0.065, -0.013)]
    return np.stack(
        [foot + np.column_stack([r * np.sin(_ROUND), line + y, r * np.cos(_ROUND)]) for r, y in profile]
    )


def cuff(skeleton: Skeleton, side: str) -> Floats:
    """A band around the end of a sleeve [rows, around, 3]."""
    wrist = skeleton.index(f"{side}_wrist")
    bone = skeleton.offsets[wrist]
    ahead = bone / np.linalg.norm(bone)
    middle = skeleton.rest_joints[wrist] - 0.2 * bone
    profile = [(0.03, -0.03), (0.0345, -0.026), (0.035, -0.006), (0.032, 0.0), (0.022, -0.004)]
    around = np.column_stack([0 * _ROUND, np.sin(_ROUND), np.cos(_ROUND) * np.sign(bone[0])])
    return np.stack([middle + r * around + along * ahead for r, along in profile])


def head(skeleton: Skeleton) -> Field:
    """Neck, skull and jaw. Only the skull turns with the head joint."""
    rest = skeleton.rest_joints
    at = skeleton.index
    centre = head_centre(skeleton)
    neck = rest[at("neck")]
    top = rest[at("head")]
    turn = at("head")
    bend = at("neck")
    wide = HEAD_SIZE[0]

    def place(x: float, y: float, z: float) -> Floats:
        return centre + _move(x, y, z)

    out = [
        # Its foot stays with the chest, so that a bent neck does not come out of the trunk.
        Capsule(at("spine3"), neck - _move(0.0, 0.045, 0.008), neck + _move(0.0, 0.005, 0.0), 0.044, 0.05),
        Capsule(bend, neck + _move(0.0, 0.02, 0.002), top + _move(0.0, 0.03, -0.022), 0.047, 0.044),
        Capsule(turn, place(0, 0.032, -0.014), place(0, 0.024, 0.014), wide, wide - 0.004),
        Capsule(turn, place(0, 0.0, -0.028), place(0, -0.005, 0.0), 0.07, 0.068),
        # Face and jaw narrow towards the chin.
        Capsule(turn, place(0, -0.01, 0.024), place(0, -0.058, 0.03), 0.063, 0.047),
        Capsule(turn, place(0, -0.05, 0.034), place(0, -0.084, 0.046), 0.044, 0.025),
    ]
    for sign in (-1.0, 1.0):
        out.append(
            Capsule(turn, place(sign * 0.036, -0.02, 0.046), place(sign * 0.03, -0.036, 0.046), 0.03, 0.03)
        )
    return Field(out, 0.008)


def nose(skeleton: Skeleton) -> Field:
    """The nose, a shape of its own: it would melt away at the head's softness."""
    centre = head_centre(skeleton)
    turn = skeleton.index("head")
    bridge = centre + _move(0, 0.012, 0.082)
    tip = centre + _move(0, -0.026, 0.1)
    wings = []
    for sign in (-1.0, 1.0):
        inner = centre + _move(0.004 * sign, -0.03, 0.09)
        outer = centre + _move(0.0095 * sign, -0.032, 0.088)
        wings.append(Capsule(turn, inner, outer, 0.008, 0.0075))
    return Field([Capsule(turn, bridge, tip, 0.0075, 0.0105), *wings], 0.003)


def hair(skeleton: Skeleton) -> Field:
    """Short hair, parted at the side: what of it is outside the skull shows."""
    centre = head_centre(skeleton)
    turn = skeleton.index("head")
    strands = [
        ((0, 0.042, -0.022), (0, 0.042, -0.004), 0.083, 0.079),
        ((0, 0.01, -0.04), (0, -0.048, -0.05), 0.074, 0.048),
        ((0.046, 0.084, 0.04), (-0.02, 0.09, 0.056), 0.022, 0.02),
        ((-0.02, 0.09, 0.056), (-0.06, 0.064, 0.036), 0.02, 0.016),
    ]
    for sign in (-1.0, 1.0):
        strands.append(((sign * 0.066, 0.05, 0.022), (sign * 0.071, 0.006, 0.018), 0.014, 0.007))
    return Field(
        [Capsule(turn, centre + np.array(a), centre + np.array(b), ra, rb) for a, b, ra, rb in strands], 0.006
    )


def ears(skeleton: Skeleton) -> Field:
    """Two ears, each a rim around a hollow."""
    centre = head_centre(skeleton)
    turn = skeleton.index("head")
    rim = np.array(
        [[77, 10, 8], [83, 24, 3], [89, 29, -10], [92, 20, -22], [91, 2, -23], [85, -17, -12], [80, -29, 0]]
    )  # fmt: skip
    out = []
    for sign in (-1.0, 1.0):
        move = np.array([sign, 1.0, 1.0]) / 1000
        for a, b in pairwise(rim):
            out.append(Capsule(turn, centre + a * move, centre + b * move, 0.0055, 0.0055))
        inner = np.array([80, 15, -9]) * move
        lobe = np.array([78, -18, -3]) * move
        out.append(Capsule(turn, centre + inner, centre + lobe, 0.0105, 0.0075))
    return Field(out, 0.0025)


def head_centre(skeleton: Skeleton) -> Floats:
    """Middle of the skull in the rest pose."""
    top = skeleton.rest_joints[skeleton.index("head")]
    out: Floats = top + np.array([0.0, 0.62 * 0.118, 0.12 * 0.098])
    return out


def _move(x: float, y: float, z: float) -> Floats:
    return np.array([x, y, z], dtype=np.float64)
