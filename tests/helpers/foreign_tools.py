"""Skeletons of the tools of the field as data: names, trees, extra joints, and where each joint sits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

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


def _chain(joints: str, prefix: str = "") -> tuple[str, ...]:
    """The joints of a chain, separated by commas."""
    return tuple(prefix + joint for joint in joints.split(", "))


def _number(word: str) -> Callable[[str, str, int], str]:
    return lambda side, finger, n: word.format(side, finger=finger, low=finger.lower(), n=n)


def _bone(thumb: str, finger: str) -> Callable[[str, int], str]:
    """Word of the n-th bone of a thumb or another finger."""
    return lambda name, n: (thumb if name == "Thumb" else finger).split()[n - 1]


_ROKOKO = _bone("Metacarpal Proximal Distal", "Proximal Medial Distal")
_UNITY = _bone("Metacarpal Proximal Distal", "Proximal Intermediate Distal")

FOREIGN = (
    Foreign(
        "Mixamo",
        (),
        _chain("Hips@pelvis, Spine@spine1, Spine1@spine2, Spine2@spine3", "mixamorig:"),
        _chain("Neck@neck, Head@head, HeadTop_End@top", "mixamorig:"),
        _chain("{}UpLeg@hip, {}Leg@knee, {}Foot@ankle, {}ToeBase@foot, {}Toe_End@toe", "mixamorig:"),
        _chain("{}Shoulder@collar, {}Arm@shoulder, {}ForeArm@elbow, {}Hand@wrist", "mixamorig:"),
        fingers=_number("mixamorig:{}Hand{finger}{n}"),
        finger_joints=4,
    ),
    Foreign(
        "CMU",
        (),
        _chain("Hips@pelvis, LowerBack@pelvis, Spine@spine1, Spine1@spine3"),
        _chain("Neck@spine3, Neck1@neck, Head@head"),
        _chain("{0[0]}HipJoint@pelvis, {}UpLeg@hip, {}Leg@knee, {}Foot@ankle, {}ToeBase@foot"),
        _chain("{}Shoulder@spine3, {}Arm@shoulder, {}ForeArm@elbow, {}Hand@wrist, {}FingerBase@middle1"),
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
        _chain("Hips@pelvis, Spine@spine1, Spine1@spine2, Spine2@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("{}UpLeg@hip, {}Leg@knee, {}Foot@ankle, {}Toe@foot"),
        _chain("{}Shoulder@collar, {}Arm@shoulder, {}ForeArm@elbow, {}Hand@wrist"),
    ),
    Foreign(
        "Rokoko",
        ("root",),
        _chain("Hips@pelvis, Spine1@spine1, Spine2@spine2, Spine3@a1, Spine4@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("{}Thigh@hip, {}Shin@knee, {}Foot@ankle, {}Toe@foot, {}ToeTip@toe"),
        _chain("{}Shoulder@collar, {}Arm@shoulder, {}ForeArm@elbow, {}Hand@wrist"),
        fingers=lambda side, name, n: f"{side}Finger{FINGERS.index(name) + 1}{_ROKOKO(name, n)}",
        hand_end="{}Tip",
        means={"spine2": ("Spine2", "Spine3")},
    ),
    Foreign(
        "Xsens MVN",
        (),
        _chain("Hips@pelvis, Chest@spine1, Chest2@spine2, Chest3@a1, Chest4@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("{}Hip@hip, {}Knee@knee, {}Ankle@ankle, {}Toe@foot"),
        _chain("{}Collar@collar, {}Shoulder@shoulder, {}Elbow@elbow, {}Wrist@wrist"),
        means={"spine2": ("Chest2", "Chest3")},
    ),
    Foreign(
        "Rigify",
        ("root",),
        _chain("spine@pelvis, spine.001@spine1, spine.002@spine2, spine.003@spine3", "DEF-"),
        _chain("spine.004@neck, spine.005@a2, spine.006@head", "DEF-"),
        _chain("pelvis.{}@a3, thigh.{}@hip, thigh.{}.001@a4, shin.{}@knee, shin.{}.001@a5", "DEF-")
        + _chain("foot.{}@ankle, toe.{}@foot", "DEF-"),
        _chain("shoulder.{}@collar, upper_arm.{}@shoulder, upper_arm.{}.001@a6", "DEF-")
        + _chain("forearm.{}@elbow, forearm.{}.001@a7, hand.{}@wrist", "DEF-"),
        sides=("L", "R"),
        fingers=lambda side, name, n: f"DEF-{'' if name == 'Thumb' else 'f_'}{name.lower()}.{n:02}.{side}",
    ),
    Foreign(
        "SMPL",
        (),
        _chain("Pelvis@pelvis, Spine1@spine1, Spine2@spine2, Spine3@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("{}_Hip@hip, {}_Knee@knee, {}_Ankle@ankle, {}_Foot@foot"),
        _chain("{}_Collar@collar, {}_Shoulder@shoulder, {}_Elbow@elbow, {}_Wrist@wrist, {}_Hand@middle1"),
        sides=("L", "R"),
    ),
    Foreign(
        "SMPL-X",
        (),
        _chain("pelvis@pelvis, spine1@spine1, spine2@spine2, spine3@spine3"),
        _chain("neck@neck, head@head, jaw@jaw"),
        _chain("{}_hip@hip, {}_knee@knee, {}_ankle@ankle, {}_foot@foot"),
        _chain("{}_collar@collar, {}_shoulder@shoulder, {}_elbow@elbow, {}_wrist@wrist"),
        sides=("left", "right"),
        fingers=_number("{}_{low}{n}"),
    ),
    Foreign(
        "BONES, SOMA 77",
        ("Root",),
        _chain("Hips@pelvis, Spine1@spine1, Spine2@spine2, Chest@spine3"),
        _chain("Neck1@neck, Neck2@a2, Head@head, HeadEnd@top"),
        _chain("{}Leg@hip, {}Shin@knee, {}Foot@ankle, {}ToeBase@foot, {}ToeEnd@toe"),
        _chain("{}Shoulder@collar, {}Arm@shoulder, {}ForeArm@elbow, {}Hand@wrist"),
        fingers=_number("{}Hand{finger}{n}"),
        finger_joints=4,
        in_palm=True,
        hand_end="{}End",
    ),
    Foreign(
        "Unreal mannequin",
        ("root",),
        _chain("pelvis@pelvis, spine_01@spine1, spine_02@b1, spine_03@spine2, spine_04@a1, spine_05@spine3"),
        _chain("neck_01@neck, neck_02@a2, head@head"),
        _chain("thigh_{}@hip, calf_{}@knee, foot_{}@ankle, ball_{}@foot"),
        _chain("clavicle_{}@collar, upperarm_{}@shoulder, lowerarm_{}@elbow, hand_{}@wrist"),
        sides=("l", "r"),
        fingers=lambda side, name, n: f"{name.lower()}_{n:02}_{side}",
        twists=("lowerarm_twist_01_{}", "lowerarm_twist_02_{}"),
    ),
    Foreign(
        "Bandai-Namco",
        ("joint_Root",),
        _chain("Hips@pelvis, Spine@spine2, Chest@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("UpperLeg_{}@hip, LowerLeg_{}@knee, Foot_{}@ankle, Toes_{}@foot"),
        _chain("Shoulder_{}@collar, UpperArm_{}@shoulder, LowerArm_{}@elbow, Hand_{}@wrist"),
        sides=("L", "R"),
        means={"spine1": ("Hips", "Spine"), "spine2": ("Spine",), "spine3": ("Chest",)},
    ),
)

OTHERS = (
    Foreign(
        "3ds Max Biped",
        ("Bip01",),
        _chain("Pelvis@pelvis, Spine@spine1, Spine1@spine2, Spine2@spine3, Neck@neck", "Bip01 "),
        _chain("Head@head, HeadNub@top", "Bip01 "),
        _chain("{} Thigh@hip, {} Calf@knee, {} Foot@ankle, {} Toe0@foot, {} Toe0Nub@toe", "Bip01 "),
        _chain("{} Clavicle@collar, {} UpperArm@shoulder, {} Forearm@elbow, {} Hand@wrist", "Bip01 "),
        sides=("L", "R"),
    ),
    Foreign(
        "Kinect",
        (),
        _chain("SpineBase@pelvis, SpineMid@spine2, SpineShoulder@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("Hip{}@hip, Knee{}@knee, Ankle{}@ankle, Foot{}@foot"),
        _chain("Shoulder{}@shoulder, Elbow{}@elbow, Wrist{}@wrist, Hand{}@middle1"),
        means={
            "spine1": ("SpineBase", "SpineMid"),
            "left_collar": ("SpineShoulder", "Neck", "ShoulderLeft"),
            "right_collar": ("SpineShoulder", "Neck", "ShoulderRight"),
        },
    ),
    Foreign(
        "CMU (ASF)",
        (),
        _chain("root@pelvis, lowerback@spine1, upperback@spine2, thorax@spine3"),
        _chain("lowerneck@neck, upperneck@a2, head@head"),
        _chain("{}hipjoint@a3, {}femur@hip, {}tibia@knee, {}foot@ankle, {}toes@foot"),
        _chain("{}clavicle@collar, {}humerus@shoulder, {}radius@elbow, {}wrist@wrist, {}hand@middle1"),
        sides=("l", "r"),
    ),
    Foreign(
        "Xsens MVN (segments)",
        (),
        _chain("Pelvis@pelvis, L5@spine1, L3@spine2, T12@a1, T8@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("{}UpperLeg@hip, {}LowerLeg@knee, {}Foot@ankle, {}Toe@foot"),
        _chain("{}Shoulder@collar, {}UpperArm@shoulder, {}Forearm@elbow, {}Hand@wrist"),
        means={"spine2": ("L3", "T12")},
    ),
    Foreign(
        "Unity, VRM",
        (),
        _chain("hips@pelvis, spine@spine1, chest@spine2, upperChest@spine3"),
        _chain("neck@neck, head@head, jaw@jaw"),
        _chain("{}UpperLeg@hip, {}LowerLeg@knee, {}Foot@ankle, {}Toes@foot"),
        _chain("{}Shoulder@collar, {}UpperArm@shoulder, {}LowerArm@elbow, {}Hand@wrist"),
        sides=("left", "right"),
        fingers=lambda side, name, n: f"{side}{name.replace('Pinky', 'Little')}{_UNITY(name, n)}",
    ),
    Foreign(
        "DAZ, Poser",
        (),
        _chain("hip@pelvis, abdomen@spine2, chest@spine3"),
        _chain("neck@neck, head@head, leftEye@jaw"),
        _chain("{}Thigh@hip, {}Shin@knee, {}Foot@ankle, {}Toe@foot"),
        _chain("{}Collar@collar, {}Shldr@shoulder, {}ForeArm@elbow, {}Hand@wrist"),
        sides=("l", "r"),
        means={"spine1": ("hip", "abdomen")},
    ),
    Foreign(
        "Axis Neuron",
        (),
        _chain("Hips@pelvis, Spine@spine1, Spine1@spine2, Spine2@a1, Spine3@spine3"),
        _chain("Neck@neck, Head@head"),
        _chain("{}UpLeg@hip, {}Leg@knee, {}Foot@ankle, {}Toe@foot"),
        _chain("{}Shoulder@collar, {}Arm@shoulder, {}ForeArm@elbow, {}Hand@wrist"),
        means={"spine2": ("Spine1", "Spine2")},
    ),
    Foreign(
        "DAZ Genesis 8",
        (),
        _chain("hip@pelvis, abdomenLower@spine1, abdomenUpper@spine2, chestLower@a1, chestUpper@spine3"),
        _chain("neckLower@neck, neckUpper@a2, head@head"),
        _chain("{}ThighBend@hip, {}ThighTwist@a4, {}Shin@knee, {}Foot@ankle")
        + _chain("{}Metatarsals@ankle, {}Toe@foot"),
        _chain("{}Collar@collar, {}ShldrBend@shoulder, {}ShldrTwist@a6, {}ForearmBend@elbow, {}Hand@wrist"),
        sides=("l", "r"),
        means={"spine2": ("abdomenUpper", "chestLower")},
    ),
    Foreign(
        "MakeHuman (CMU rig)",
        ("Root",),
        _chain("Hips@pelvis, Spine1@spine1, Spine2@spine2, Spine3@spine3"),
        _chain("Neck@neck, Head@head, __Jaw@jaw, Jaw@jaw"),
        _chain("__UpLeg_{}@a3, UpLeg_{}@hip, LoLeg_{}@knee, Foot_{}@ankle, Toe_{}@foot"),
        _chain("Clavicle_{}@collar, UpArm_{}@shoulder, LoArm_{}@elbow, Hand_{}@wrist"),
        sides=("L", "R"),
        fingers=lambda side, name, n: f"{name}{n}_{side}",
    ),
    Foreign(
        "MakeHuman (default rig)",
        (),
        _chain("root@pelvis, spine05@spine1, spine04@b1, spine03@spine2, spine02@a1, spine01@spine3"),
        _chain("neck01@neck, neck02@a2, head@head"),
        _chain("pelvis.{}@a3, upperleg01.{}@hip, upperleg02.{}@a4, lowerleg01.{}@knee, lowerleg02.{}@a5")
        + _chain("foot.{}@ankle, toe1-1.{}@foot"),
        _chain("clavicle.{}@collar, upperarm01.{}@shoulder, upperarm02.{}@a6, lowerarm01.{}@elbow")
        + _chain("lowerarm02.{}@a7, wrist.{}@wrist"),
        sides=("L", "R"),
        fingers=lambda side, name, n: f"finger{FINGERS.index(name) + 1}-{n}.{side}",
    ),
)
