"""What would make people of the clips that a look has read: two joints exchanged, another axis, another unit.

Each is tried on what the ones before it leave, so that several mistakes at once are all named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.motion.joint_map import METRES
from motionloom.datasets.motion.standing import MOST, PERSON_METRES, Crowd, measure
from motionloom.datasets.motion.swapped_joints import Swap

Names = tuple[str | tuple[str, ...], ...]
"""What stands for each joint in a file; empty where no joint map says it."""


@dataclass(frozen=True)
class Suggestion:
    """A change that makes people of what was seen."""

    option: Literal["up", "unit", "joint_map", "source"]
    value: str
    """What to give it: an axis, a unit, or lines of the joint map; a sentence where no option helps."""
    why: str

    def __str__(self) -> str:
        if self.option in ("up", "unit"):
            return f"--{self.option} {self.value} ({self.why})"
        if self.option == "joint_map":
            return f"in the joint map: {self.value} ({self.why})"
        return f"{self.value} ({self.why})"


@dataclass(frozen=True)
class SeenClip:
    """One clip that was read: its frames at about ten a second."""

    subset: str
    joints: NDArray[np.float64]
    fps: float
    file_fps: float


def crowd_of(clips: Iterable[SeenClip]) -> Crowd:
    """The clips measured."""
    crowd = Crowd()
    for clip in clips:
        crowd.add(measure(clip.joints, clip.fps))
    return crowd


def suggest(
    clips: list[SeenClip],
    swap: Swap | None,
    config: ConvertConfig,
    names: Names,
    up: str,
) -> list[Suggestion]:
    """Changes that together make people of the clips, one after the other: joints, axis, unit, sides."""
    out: list[Suggestion] = []
    joints = [clip.joints for clip in clips]
    if swap is not None:
        joints = [swap.undo(each) for each in joints]
        out.append(_swap_suggestion(swap, names))
    now = _again(clips, joints)
    if now.upright <= MOST:
        axis = head_axis(_with(clips, joints), up)
        joints = [_turned(each, up, axis) for each in joints]
        out.append(_axis_suggestion(axis, config))
        now = _again(clips, joints)
    if not PERSON_METRES[0] <= now.height <= PERSON_METRES[1]:
        factor, suggestion = _unit_suggestion(now.height, config)
        joints = [each * factor for each in joints]
        out.append(suggestion)
        now = _again(clips, joints)
    if any(oddity.kind == "left and right" and oddity.is_error for oddity in now.oddities()):
        why = "the feet point backwards"
        if names:
            out.append(Suggestion("joint_map", "exchange the left and the right rows", why))
        else:
            out.append(Suggestion("source", "exchange left and right in the source", why))
    return out


def _swap_suggestion(swap: Swap, names: Names) -> Suggestion:
    first, second = swap.names
    if not names:
        return Suggestion("source", f"exchange {first} and {second} in the source", "bones change length")

    def line(joint: int, name: str, other: int) -> str:
        source = names[other]
        word = f'"{source}"' if isinstance(source, str) else str(list(source)).replace("'", '"')
        return f'[{joint}, "{name}", {word}]'

    lines = f"{line(swap.first, first, swap.second)}, {line(swap.second, second, swap.first)}"
    return Suggestion("joint_map", lines, "then bones keep their length")


def _axis_suggestion(axis: str, config: ConvertConfig) -> Suggestion:
    why = f"the head is above the pelvis along the {axis} axis of the files"
    if hasattr(config, "up") and axis in ("+y", "+z"):
        return Suggestion("up", axis[1], why)
    return Suggestion("source", "turn the files so that y or z points up", why)


def _unit_suggestion(height: float, config: ConvertConfig) -> tuple[float, Suggestion]:
    """The factor that makes a person of a figure of `height`, and the unit that has it."""
    given = METRES.get(getattr(config, "unit", "m"), 1.0)
    factors = {unit: metres / given for unit, metres in METRES.items()}
    fits = {u: f for u, f in factors.items() if PERSON_METRES[0] <= height * f <= PERSON_METRES[1]}
    if not fits:
        why = f"the figures are {height:.3g} m tall, and no unit makes 1.2 to 2.2 m of it"
        return 1.7 / max(height, 1e-9), Suggestion("source", "scale the files", why)
    unit, factor = min(fits.items(), key=lambda item: abs(np.log(height * item[1] / 1.7)))
    why = f"then the figures are {height * factor:.2f} m tall"
    if hasattr(config, "unit"):
        return factor, Suggestion("unit", unit, why)
    return factor, Suggestion("source", f"the lengths look like {unit}: scale the files to metres", why)


def _with(clips: list[SeenClip], joints: list[NDArray[np.float64]]) -> list[SeenClip]:
    return [
        SeenClip(clip.subset, each, clip.fps, clip.file_fps) for clip, each in zip(clips, joints, strict=True)
    ]


def _again(clips: list[SeenClip], joints: list[NDArray[np.float64]]) -> Crowd:
    return crowd_of(_with(clips, joints))


def _file_axes(vectors: NDArray[Any], up: str) -> NDArray[Any]:
    """Vectors [..., 3] with Y up, in the axes of the files, of which `up` was taken for the upward one."""
    if up == "z":
        return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)
    return vectors


def head_axis(clips: Iterable[SeenClip], up: str) -> str:
    """The axis of the files along which the head lies from the pelvis in most clips."""
    found: Counter[str] = Counter()
    for clip in clips:
        way = _file_axes(np.array(measure(clip.joints, clip.fps).up), up)
        axis = int(np.abs(way).argmax())
        found[("+" if way[axis] > 0 else "-") + "xyz"[axis]] += 1
    return found.most_common(1)[0][0]


def _turned(joints: NDArray[np.float64], up: str, axis: str) -> NDArray[np.float64]:
    """Joints with Y up, when `axis` of the files is the upward one after all."""
    x, y, z = np.moveaxis(_file_axes(joints, up), -1, 0)
    turned = {
        "+y": (x, y, z),
        "-y": (x, -y, -z),
        "+z": (x, z, -y),
        "-z": (x, -z, y),
        "+x": (-y, x, z),
        "-x": (y, -x, z),
    }[axis]
    return np.stack(turned, axis=-1)
