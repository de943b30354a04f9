"""How tools name the joints of a figure, as a table: to know another tool, add a row.

Words are what `names.py` leaves of a name: no side, prefix, punctuation, capitals or leading zeros, so
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
    neck: tuple[str, str]
    """Neck, head."""
    leg: tuple[str, str, str, str]
    """Hip, knee, ankle, ball of the foot."""
    arm: tuple[str, str, str, str]
    """Collar, shoulder, elbow, wrist."""
    fingers: FingerWords | None = None


def _fingers(prefix: str, joints: tuple[str, ...], thumb: tuple[str, ...] | None = None) -> FingerWords:
    return FingerWords(tuple(prefix + finger for finger in FINGERS), joints, thumb or joints)


def _numbered(names: tuple[str, ...], joints: tuple[str, ...], thumb: tuple[str, ...]) -> FingerWords:
    """`names` count from the thumb, as tools without finger names do."""
    thumb_name, index, middle, ring, pinky = names
    return FingerWords((index, middle, pinky, ring, thumb_name), joints, thumb)


_FOUR = ("1", "2", "3", "4")
_HANDS = _fingers("hand", _FOUR)
_SHOULDER_ARM = ("shoulder", "arm", "forearm", "hand")
_LIMBS_OF_SMPL = ("collar", "shoulder", "elbow", "wrist")
_UNITY_LEG = ("upperleg", "lowerleg", "foot", "toes")

CONVENTIONS = (
    Convention(
        "Mixamo, HumanIK, LAFAN1",
        ("hips", "spine", "spine1", "spine2"),
        ("neck", "head"),
        ("upleg", "leg", "foot", "toebase"),
        _SHOULDER_ARM,
        _HANDS,
    ),
    Convention(
        "CMU",
        ("hips", "lowerback", "spine", "spine1"),
        ("neck", "head"),
        ("upleg", "leg", "foot", "toebase"),
        _SHOULDER_ARM,
    ),
    Convention(
        "CMU (ASF)",
        ("root", "lowerback", "upperback", "thorax"),
        ("lowerneck", "head"),
        ("femur", "tibia", "foot", "toes"),
        ("clavicle", "humerus", "radius", "wrist"),
    ),
    Convention(
        "BONES, SOMA",
        ("hips", "spine1", "spine2", "chest"),
        ("neck1", "head"),
        ("leg", "shin", "foot", "toebase"),
        _SHOULDER_ARM,
        _HANDS,
    ),
    Convention(
        "Rokoko",
        ("hips", "spine1", "spine2", "spine3", "spine4"),
        ("neck", "head"),
        ("thigh", "shin", "foot", "toe"),
        _SHOULDER_ARM,
        _numbered(
            ("finger1", "finger2", "finger3", "finger4", "finger5"),
            ("proximal", "medial", "distal"),
            ("metacarpal", "proximal", "distal"),
        ),
    ),
    Convention(
        "Xsens MVN (BVH)",
        ("hips", "chest", "chest2", "chest3", "chest4"),
        ("neck", "head"),
        ("hip", "knee", "ankle", "toe"),
        _LIMBS_OF_SMPL,
    ),
    Convention(
        "Xsens MVN (segments)",
        ("pelvis", "l5", "l3", "t12", "t8"),
        ("neck", "head"),
        ("upperleg", "lowerleg", "foot", "toe"),
        ("shoulder", "upperarm", "forearm", "hand"),
        _numbered(("first", "second", "third", "fourth", "fifth"), ("pp", "mp", "dp"), ("mc", "pp", "dp")),
    ),
    Convention(
        "Blender Rigify",
        ("spine", "spine1", "spine2", "spine3"),
        ("spine4", "spine6"),
        ("thigh", "shin", "foot", "toe"),
        ("shoulder", "upperarm", "forearm", "hand"),
        FingerWords(("findex", "fmiddle", "fpinky", "fring", "thumb"), _FOUR, _FOUR),
    ),
    Convention(
        "SMPL, SMPL-H, SMPL-X",
        ("pelvis", "spine1", "spine2", "spine3"),
        ("neck", "head"),
        ("hip", "knee", "ankle", "foot"),
        _LIMBS_OF_SMPL,
        _fingers("", _FOUR),
    ),
    Convention(
        "Unreal mannequin",
        ("pelvis", "spine1", "spine2", "spine3", "spine4", "spine5"),
        ("neck1", "head"),
        ("thigh", "calf", "foot", "ball"),
        ("clavicle", "upperarm", "lowerarm", "hand"),
        _fingers("", _FOUR),
    ),
    Convention(
        "Bandai-Namco, Unity, VRM",
        ("hips", "spine", "chest", "upperchest"),
        ("neck", "head"),
        _UNITY_LEG,
        ("shoulder", "upperarm", "lowerarm", "hand"),
        FingerWords(
            ("index", "middle", "little", "ring", "thumb"),
            ("proximal", "intermediate", "distal"),
            ("metacarpal", "proximal", "distal"),
        ),
    ),
    Convention(
        "3ds Max Biped",
        ("pelvis", "spine", "spine1", "spine2"),
        ("neck", "head"),
        ("thigh", "calf", "foot", "toe0"),
        ("clavicle", "upperarm", "forearm", "hand"),
    ),
    Convention(
        "DAZ, Poser",
        ("hip", "abdomen", "chest"),
        ("neck", "head"),
        ("thigh", "shin", "foot", "toe"),
        ("collar", "shldr", "forearm", "hand"),
    ),
    Convention(
        "Kinect",
        ("spinebase", "spinemid", "spineshoulder"),
        ("neck", "head"),
        ("hip", "knee", "ankle", "foot"),
        ("", "shoulder", "elbow", "wrist"),
    ),
)

_ENDS = ("end", "leaf", "nub", "site", "tip", "top")
_HANDLES = ("ctrl", "eff", "effector", "helper", "ik", "pole", "prop", "target", "weapon")
SPARE_WORDS = frozenset([*_ENDS, *_HANDLES, "eye", "jaw", "roll", "twist"])
"""A name with one of these words is no joint of the body: ends of chains, twist bones, handles."""

SIDE_WORDS = {"left": "left", "lft": "left", "l": "left", "right": "right", "rgt": "right", "r": "right"}
