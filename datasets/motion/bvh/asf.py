"""Acclaim files (CMU, HDM05): an ASF skeleton and the AMC motions of its subject, read as `BvhMotion`.

A bone starts where its parent ends and rotates by `C M C^-1`, where `C` is the bone's `axis` and `M` its
degrees of freedom in the order of `dof` (angles about fixed axes: `rx ry rz` = Rz Ry Rx on column vectors).
So a bone is a joint at its parent's end with three rotation channels, and its own end is the offset of its
children. Lengths become centimetres: CMU's unit is `length 0.45`, inches divided by 0.45.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from dataclasses import dataclass

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import number
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.bvh.text import LARGEST, Floats, is_number, shown

INCH = 2.54
"""Centimetres."""

FPS = 120.0
"""An AMC file does not say its frame rate; the public collections have this one."""

JOINED = b"\n\0\n"
"""Separator of the two texts where both are read as one."""

_CHANNELS = ("Zrotation", "Xrotation", "Yrotation")
_ROOT = ("Xposition", "Yposition", "Zposition", *_CHANNELS)
_FRAME = re.compile(rb"^[ \t]*\d+[ \t\r]*$", re.MULTILINE)


@dataclass(frozen=True)
class _Bone:
    """A bone of the ASF; the root has no length."""

    end: Floats
    """Vector from its start to its end [3], in centimetres, in the rest pose."""
    axis: tuple[str, tuple[float, ...]]
    """Order of the local frame's angles, and the angles in degrees."""
    dof: tuple[str, ...]
    """`rx`, `ry`, `rz` (and `tx`, `ty`, `tz` of the root), in the order of the numbers of an AMC line."""


@dataclass(frozen=True)
class _Skeleton:
    bones: dict[str, _Bone]
    """Parents before children."""
    parents: tuple[int, ...]
    unit: float
    """Centimetres in a length of the files."""
    degree: float
    """Degrees in an angle of the files: 1, or 180 / pi where they are radians."""


def read_amc(asf: bytes, amc: bytes, *, name: str) -> BvhMotion:
    """Read one motion of a subject, in centimetres; a `UserError` names file, bone and fault."""
    skeleton = _skeleton(asf, f"{name} (its .asf)")
    numbers, frames = _frames(amc, skeleton.bones, name)
    names = tuple(skeleton.bones)
    parents = skeleton.parents
    ends = [skeleton.bones[bone].end for bone in names]
    turned = [
        _turned(bone, numbers.get(key), frames, skeleton.degree) for key, bone in skeleton.bones.items()
    ]
    order = skeleton.bones["root"].dof
    moved = [numbers["root"][:, [order.index(axis)]] * skeleton.unit for axis in ("tx", "ty", "tz")]
    return BvhMotion(
        name=name,
        joints=names,
        parents=parents,
        offsets=np.array([ends[parent] if parent >= 0 else np.zeros(3) for parent in parents]),
        channels=(_ROOT, *[_CHANNELS] * (len(names) - 1)),
        values=np.concatenate([*moved, *turned], axis=1),
        fps=FPS,
    )


def frame_marks(amc: bytes, where: str) -> list[tuple[int, int]]:
    """Return the places of the lines that number the frames of an AMC text."""
    marks = [mark.span() for mark in _FRAME.finditer(amc)]
    if not marks:
        raise UserError(f"{where}: no frames; an AMC file numbers each on a line of its own")
    return marks


def skeleton_of(asf: bytes, name: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the joints of an ASF, and the parent of each (-1 = root)."""
    skeleton = _skeleton(asf, name)
    return tuple(skeleton.bones), skeleton.parents


def _turned(bone: _Bone, numbers: Floats | None, frames: int, degree: float) -> Floats:
    """Angles [T, 3] of `C M C^-1` for the three rotation channels."""
    from scipy.spatial.transform import Rotation

    columns = [column for column, dof in enumerate(bone.dof) if dof[0] == "r"]
    if numbers is None or not columns:
        return np.zeros((frames, 3))
    order = "".join(bone.dof[column][1] for column in columns)
    # ASF states a bone's rotation M in axes of its own, C, which BVH does not have.
    axis = Rotation.from_euler(*bone.axis, degrees=True)
    turn = axis * Rotation.from_euler(order, numbers[:, columns] * degree, degrees=True) * axis.inv()
    with warnings.catch_warnings():  # at a gimbal lock one of the many equal answers is as good as another
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(turn.as_euler("ZXY", degrees=True), dtype=np.float64)


def _skeleton(text: bytes, where: str) -> _Skeleton:
    sections = _sections(text)
    missing = [key for key in ("root", "bonedata", "hierarchy") if key not in sections]
    if missing:
        raise UserError(f"{where}: no :{missing[0]} section; an ASF skeleton needs one")
    units = {line[0]: line[1] for line in sections.get("units", []) if len(line) > 1}
    degree = 1.0 if units.get("angle", "deg").startswith("deg") else 180 / np.pi
    try:
        unit = INCH / number(units.get("length", "1"), "length", LARGEST, 1 / LARGEST)
        bones = _bones(sections, unit, degree)
    except (UserError, ValueError, IndexError, KeyError) as error:
        raise UserError(f"{where}: a bone or unit cannot be read ({error})") from None
    # Bones are numbered in the order of the hierarchy, in which parents must come first.
    parents = {"root": -1}
    for line in sections["hierarchy"]:
        for child in line[1:]:
            if line[0] not in parents or child in parents or child not in bones:
                raise UserError(
                    f"{where}: :hierarchy '{' '.join(line)[:60]}' names '{child[:40]}', which is no "
                    "bone, has two parents, or comes before its parent"
                )
            parents[child] = list(parents).index(line[0])
    return _Skeleton({bone: bones[bone] for bone in parents}, tuple(parents.values()), unit, degree)


def _sections(text: bytes) -> dict[str, list[list[str]]]:
    """Words of the lines of each `:section`, without comments and `begin`/`end`."""
    sections: dict[str, list[list[str]]] = {}
    lines: list[list[str]] = []
    for raw in text.decode("utf-8", "replace").splitlines():
        words = raw.split("#")[0].split()
        if words and words[0].startswith(":"):
            lines = sections.setdefault(words[0][1:].lower(), [])
            words = words[1:]
        if words and words[0] not in ("begin", "end"):
            lines.append(words)
    return sections


def _bones(sections: dict[str, list[list[str]]], unit: float, degree: float) -> dict[str, _Bone]:
    root = {line[0]: line[1:] for line in sections["root"]}
    axis = _axis([*root.get("orientation", ["0", "0", "0"]), root.get("axis", ["XYZ"])[0]], degree)
    bones = {"root": _Bone(np.zeros(3), axis, _freedom(root["order"]))}
    if not {"tx", "ty", "tz"} <= {*bones["root"].dof}:
        raise ValueError("the root's order lacks one of TX, TY and TZ")
    fields: dict[str, list[str]] = {}
    # A bone ends where the next one's id begins; one more id ends the last.
    for line in [*sections["bonedata"], ["id"]]:
        if line[0] == "id" and fields:
            direction = np.array(_numbers(fields["direction"][:3], 3))
            if not (far := float(np.linalg.norm(direction))):
                raise ValueError(f"'{fields['name'][0]}' has no direction")
            (length,) = _numbers(fields["length"][:1], 1)
            dof = _freedom([word for word in fields.get("dof", ()) if word.lower() != "l"])
            end = unit * length * direction / far
            bones[fields["name"][0]] = _Bone(end, _axis(fields["axis"], degree), dof)
            fields = {}
        fields[line[0]] = line[1:]
    return bones


def _numbers(words: list[str], count: int) -> tuple[float, ...]:
    """So many numbers of words; `ValueError` for others."""
    if len(words) != count:
        raise ValueError(f"{count} numbers are expected, not '{' '.join(words):.60}'")
    return tuple(number(word, "a number", LARGEST, -LARGEST) for word in words)


def _axis(words: list[str], degree: float) -> tuple[str, tuple[float, ...]]:
    """Order and angles in degrees of a bone's own frame, of the words behind `axis`."""
    if sorted(words[-1].lower()) != ["x", "y", "z"]:
        raise ValueError(f"'{words[-1]:.40}' is no order of X, Y and Z")
    return words[-1].lower(), tuple(degree * angle for angle in _numbers(words[:-1], 3))


def _freedom(words: list[str]) -> tuple[str, ...]:
    """Degrees of freedom, each once."""
    found = tuple(word.lower() for word in words)
    if len({*found}) < len(found) or not {*found} <= {"rx", "ry", "rz", "tx", "ty", "tz"}:
        raise ValueError(f"'{' '.join(words):.60}' are no degrees of freedom")
    return found


def _frames(text: bytes, bones: dict[str, _Bone], where: str) -> tuple[dict[str, Floats], int]:
    """Numbers of every bone that the file moves [T, degrees of freedom], and T."""
    marks = frame_marks(text, where)
    frames = [text[a:b].split() for (_, a), (b, _) in zip(marks, [*marks[1:], (len(text), 0)], strict=True)]
    moved = [word.decode("utf-8", "replace") for word in frames[0] if word[:1].isalpha()]
    stray = [bone for bone in moved if bone not in bones]
    if stray or "root" not in moved or max(Counter(moved).values()) > 1:
        wrong = f"bone '{stray[0][:40]}' is not in its .asf" if stray else "needs `root` and each bone once"
        raise UserError(f"{where}: frame 1: {wrong}; is the .asf another subject's?")
    # The first frame says which bones move; all others must name the same, so that columns can be cut out.
    widths = [len(bones[bone].dof) for bone in moved]
    starts = np.cumsum([0, *(1 + width for width in widths)])
    for frame, words in enumerate(frames, 1):
        if len(words) != starts[-1] or [words[at] for at in starts[:-1]] != [bone.encode() for bone in moved]:
            raise UserError(
                f"{where}: frame {frame}: other bones or numbers than the first frame and the .asf say"
            )
    table: dict[str, Floats] = {}
    for bone, at, width in zip(moved, starts, widths, strict=False):
        rows = [words[at + 1 : at + 1 + width] for words in frames]
        try:
            table[bone] = np.array(rows, dtype=np.float64)
        except ValueError:
            table[bone] = np.array(np.nan)
        if not (np.abs(table[bone]) <= LARGEST).all():  # false for NaN
            found = ((frame, word) for frame, row in enumerate(rows, 1) for word in row)
            frame, word = next((one for one in found if not is_number(one[1])), (1, b""))
            raise UserError(
                f"{where}: frame {frame}: bone '{bone}': '{shown(word)}' is not a finite number up to "
                f"{LARGEST:g}"
            )
    return table, len(frames)
