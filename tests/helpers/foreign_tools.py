"""Skeletons of the tools of the field: names, trees, extra joints, and where each joint sits."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")


@dataclass(frozen=True)
class Foreign:
    """One tool's figure. Joints are `NAME@PLACE`; `{}` is the word for the side; places have none."""

    tool: str
    trunk: tuple[str, ...]
    """From the pelvis up to where the arms branch."""
    neck: tuple[str, ...]
    leg: tuple[str, ...]
    arm: tuple[str, ...]
    above: tuple[str, ...] = ()
    """Names above the pelvis, on the floor."""
    sides: tuple[str, ...] = ("Left", "Right")
    fingers: str = ""
    """Name of a finger's joint: of side, finger (`low`: in small letters, `place`: from 1), number, bone."""
    thumb: str = ""
    """The same for thumbs, where they differ."""
    bones: str = ""
    thumb_bones: str = ""
    pinky: str = "Pinky"
    finger_joints: int = 3
    in_palm: bool = False
    """Whether fingers (not thumbs) begin with a bone in the palm."""
    hand_end: str = ""
    """A joint after the last of a finger, for example `{}End`."""
    means: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Of our joints that no place gives: the sources that a person would choose."""
    twists: tuple[str, ...] = ()
    """Side branches of the elbow."""

    def finger(self, side: str, finger: str, n: int) -> str:
        """Name of joint number `n`, from 1."""
        is_thumb = finger == "Thumb"
        bones = (self.thumb_bones if is_thumb else self.bones).split()
        word = self.thumb if is_thumb and self.thumb else self.fingers
        finger, place = self.pinky if finger == "Pinky" else finger, FINGERS.index(finger) + 1
        bone = bones[n - 1] if bones else ""
        return word.format(side=side, finger=finger, low=finger.lower(), place=place, n=n, bone=bone)


def _read(row: dict[str, Any]) -> Foreign:
    chains = ("trunk", "neck", "leg", "arm", "above", "sides", "twists")
    listed = {key: tuple(row.pop(key).split(", ")) for key in chains if key in row}
    means = {joint: tuple(names.split(", ")) for joint, names in row.pop("means", {}).items()}
    return Foreign(**row, **listed, means=means)


_TABLE = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))
FOREIGN = tuple(map(_read, _TABLE["foreign"]))
OTHERS = tuple(map(_read, _TABLE["others"]))
