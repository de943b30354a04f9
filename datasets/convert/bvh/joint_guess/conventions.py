"""How tools name the joints of a figure, as a table: to know another tool, add a row.

Words are what `figure.py` leaves of a name: no side, prefix, punctuation, capitals or leading zeros, so
`mixamorig:LeftUpLeg` is `upleg`, `DEF-upper_arm.L` is `upperarm` and `spine_01` is `spine1`. One word may
mean two joints (`leg` is Mixamo's shin and SOMA's thigh, `shoulder` a collar bone or the arm's first joint):
what settles it is which other words lie on the same chain (`limbs.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
"""The fingers of `smplx52`, in its order."""


@dataclass(frozen=True)
class FingerWords:
    """Words of a hand: a finger's name followed by a joint's, outwards from the knuckle."""

    names: tuple[str, ...]
    """Of `FINGERS`."""
    joints: tuple[str, ...]
    thumb: tuple[str, ...]

    def chain(self, finger: str) -> tuple[str, ...]:
        """Words of the joints of one finger, outwards."""
        name = self.names[FINGERS.index(finger)]
        return tuple(name + joint for joint in (self.thumb if finger == "thumb" else self.joints))


@dataclass(frozen=True)
class Convention:
    """Words of one tool's skeleton; an empty word is a joint that it does not have."""

    tool: str
    trunk: tuple[str, ...]
    """Pelvis, spine upwards."""
    neck: tuple[str, ...]
    """Neck, head."""
    leg: tuple[str, ...]
    """Hip, knee, ankle, ball of the foot."""
    arm: tuple[str, ...]
    """Collar, shoulder, elbow, wrist."""
    fingers: FingerWords | None = None


_TABLE = """
Mixamo, HumanIK, LAFAN1 | hips spine spine1 spine2 | neck head | upleg leg foot toebase | shoulder arm forearm hand
CMU | hips lowerback spine spine1 | neck head | upleg leg foot toebase | shoulder arm forearm hand
CMU (ASF) | root lowerback upperback thorax | lowerneck head | femur tibia foot toes | clavicle humerus radius wrist
BONES, SOMA | hips spine1 spine2 chest | neck1 head | leg shin foot toebase | shoulder arm forearm hand
Rokoko | hips spine1 spine2 spine3 spine4 | neck head | thigh shin foot toe | shoulder arm forearm hand
Xsens MVN (BVH) | hips chest chest2 chest3 chest4 | neck head | hip knee ankle toe | collar shoulder elbow wrist
Xsens MVN (segments) | pelvis l5 l3 t12 t8 | neck head | upperleg lowerleg foot toe | shoulder upperarm forearm hand
Blender Rigify | spine spine1 spine2 spine3 | spine4 spine6 | thigh shin foot toe | shoulder upperarm forearm hand
SMPL, SMPL-H, SMPL-X | pelvis spine1 spine2 spine3 | neck head | hip knee ankle foot | collar shoulder elbow wrist
Unreal mannequin | pelvis spine1 spine2 spine3 spine4 spine5 | neck1 head | thigh calf foot ball | clavicle upperarm lowerarm hand
Bandai-Namco, Unity, VRM | hips spine chest upperchest | neck head | upperleg lowerleg foot toes | shoulder upperarm lowerarm hand
3ds Max Biped | pelvis spine spine1 spine2 | neck head | thigh calf foot toe0 | clavicle upperarm forearm hand
DAZ, Poser | hip abdomen chest | neck head | thigh shin foot toe | collar shldr forearm hand
Kinect | spinebase spinemid spineshoulder | neck head | hip knee ankle foot | - shoulder elbow wrist
"""  # noqa: E501 (a table)
"""Tool | pelvis, spine upwards | neck, head | leg | arm; `-` is a joint that the tool does not have."""

_FOUR = ("1", "2", "3", "4")
_HANDS = FingerWords(tuple(f"hand{finger}" for finger in FINGERS), _FOUR, _FOUR)
_PLAIN = FingerWords(FINGERS, _FOUR, _FOUR)
_UNITY = ("index", "middle", "little", "ring", "thumb")
_FINGERS = {
    "Mixamo, HumanIK, LAFAN1": _HANDS,
    "BONES, SOMA": _HANDS,
    "Rokoko": FingerWords(  # numbered from the thumb
        ("finger2", "finger3", "finger5", "finger4", "finger1"),
        ("proximal", "medial", "distal"),
        ("metacarpal", "proximal", "distal"),
    ),
    "Xsens MVN (segments)": FingerWords(
        ("second", "third", "fifth", "fourth", "first"), ("pp", "mp", "dp"), ("mc", "pp", "dp")
    ),
    "Blender Rigify": FingerWords(("findex", "fmiddle", "fpinky", "fring", "thumb"), _FOUR, _FOUR),
    "SMPL, SMPL-H, SMPL-X": _PLAIN,
    "Unreal mannequin": _PLAIN,
    "Bandai-Namco, Unity, VRM": FingerWords(
        _UNITY, ("proximal", "intermediate", "distal"), ("metacarpal", "proximal", "distal")
    ),
}


def _convention(row: str) -> Convention:
    tool, *parts = (part.strip() for part in row.split("|"))
    trunk, neck, leg, arm = (tuple(word.strip("-") for word in part.split()) for part in parts)
    return Convention(tool, trunk, neck, leg, arm, _FINGERS.get(tool))


CONVENTIONS = tuple(map(_convention, _TABLE.strip().splitlines()))

_ENDS = ("end", "leaf", "nub", "site", "tip", "top")
_HANDLES = ("ctrl", "eff", "effector", "helper", "ik", "pole", "prop", "target", "weapon")
SPARE_WORDS = frozenset([*_ENDS, *_HANDLES, "eye", "jaw", "roll", "twist"])
"""A name with one of these words is no joint of the body: ends of chains, twist bones, handles."""

SIDE_WORDS = {"left": "left", "lft": "left", "l": "left", "right": "right", "rgt": "right", "r": "right"}
