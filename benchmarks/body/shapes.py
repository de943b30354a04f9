"""The shapes of the figure, hung on the rest joints of a skeleton: trunk and limbs, hands, head.

A lay figure, not a likeness: one closed mesh of trunk, arms, legs and feet, hands that sit in the wrists like
ball joints, a head on its neck. Radii are those of an adult of 1.7 m.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from field import Capsule, Field
from numpy.typing import NDArray

from motionloom.datasets.motion.skeleton import Skeleton

Floats = NDArray[np.float64]

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
HEAD_SIZE = (0.079, 0.112, 0.094)
"""Half width, half height, half depth of the skull in metres."""
_KNUCKLE = {"index": 0.0108, "middle": 0.0112, "ring": 0.0104, "pinky": 0.0092, "thumb": 0.0122}


def trunk_and_limbs(skeleton: Skeleton) -> Field:
    """Everything but hands and head."""
    rest, at = skeleton.rest_joints, skeleton.index
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
        # The forearm is thickest below the elbow.
        belly = elbow + 0.28 * (wrist - elbow)
        add(f"{side}_elbow", elbow, belly, 0.038, 0.042)
        add(f"{side}_elbow", belly, wrist, 0.042, 0.0285, 0.92)
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
    """Palm, fingers and thumb; the heel of the hand ends inside the forearm."""
    rest, at = skeleton.rest_joints, skeleton.index
    wrist = rest[at(f"{side}_wrist")]
    out: list[Capsule] = []
    palm = at(f"{side}_wrist")
    out.append(Capsule(palm, wrist - 0.02 * _unit(skeleton, f"{side}_wrist"), wrist, 0.022, 0.0235))
    for finger in FINGERS:
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


def head(skeleton: Skeleton) -> Field:
    """Neck, skull, jaw, nose and ears. Only the skull turns with the head joint."""
    rest, at = skeleton.rest_joints, skeleton.index
    centre, neck, top = head_centre(skeleton), rest[at("neck")], rest[at("head")]
    turn, bend = at("head"), at("neck")
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
        out.append(
            Capsule(
                turn, place(sign * 0.081, 0.016, -0.012), place(sign * 0.077, -0.02, -0.004), 0.014, 0.01, 1.4
            )
        )
    return Field(out, 0.008)


def nose(skeleton: Skeleton) -> Field:
    """The nose, a shape of its own: it would melt away at the head's softness."""
    centre, turn = head_centre(skeleton), skeleton.index("head")
    bridge, tip = centre + _move(0, 0.012, 0.082), centre + _move(0, -0.026, 0.1)
    wings = []
    for sign in (-1.0, 1.0):
        inner, outer = centre + _move(0.004 * sign, -0.03, 0.09), centre + _move(0.0095 * sign, -0.032, 0.088)
        wings.append(Capsule(turn, inner, outer, 0.008, 0.0075))
    return Field([Capsule(turn, bridge, tip, 0.0075, 0.0105), *wings], 0.003)


def head_centre(skeleton: Skeleton) -> Floats:
    """Middle of the skull in the rest pose."""
    top = skeleton.rest_joints[skeleton.index("head")]
    out: Floats = top + np.array([0.0, 0.62 * 0.118, 0.12 * 0.098])
    return out


def _unit(skeleton: Skeleton, joint: str) -> Floats:
    bone: Any = skeleton.offsets[skeleton.index(joint)]
    out: Floats = bone / np.linalg.norm(bone)
    return out


def _move(x: float, y: float, z: float) -> Floats:
    return np.array([x, y, z], dtype=np.float64)
