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
