"""Joints as people call them: "left index finger, middle joint" for `left_index2`."""

from __future__ import annotations

from motionloom.pipeline.render.labels import label

_NAMES = {
    "collar": "collarbone",
    "foot": "ball of the foot",
    "spine1": "lower spine",
    "spine2": "middle spine",
    "spine3": "upper spine",
    "pinky": "little finger",
    "index": "index finger",
    "middle": "middle finger",
    "ring": "ring finger",
}
_ALONG_FINGER = {"1": "knuckle", "2": "middle joint", "3": "last joint"}
_ALONG_THUMB = {"1": "base", "2": "middle joint", "3": "last joint"}


def joint_label(joint: str) -> str:
    """A joint of `smpl22` or `smplx52` in words; other names without their underscores."""
    side, _, rest = joint.partition("_")
    if side not in ("left", "right"):
        return _NAMES.get(joint, label(joint))
    finger, place = rest[:-1], rest[-1:]
    if finger == "thumb" and place in _ALONG_THUMB:
        return f"{side} thumb, {_ALONG_THUMB[place]}"
    if finger in _NAMES and place in _ALONG_FINGER:
        return f"{side} {_NAMES[finger]}, {_ALONG_FINGER[place]}"
    return f"{side} {_NAMES.get(rest, label(rest))}"
