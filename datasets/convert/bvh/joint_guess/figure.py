"""A foreign figure as a guess sees it: how tools name joints (`tools.csv`), then names, tree, and some poses.

To know another tool, add a row. Words of the table are what is left of a name: no side, prefix, punctuation,
capitals or leading zeros, so `mixamorig:LeftUpLeg` is `upleg`, `DEF-upper_arm.L` is `upperarm` and `spine_01`
is `spine1`. One word may mean two joints (`leg` is Mixamo's shin and SOMA's thigh, `shoulder` a collar bone
or the arm's first joint): what settles it is which other words lie on the same chain (`limbs.py`).

Nothing depends on the figure's unit or up axis. The poses are frames of the clip and not the OFFSETs: many
tools (LAFAN1, Bandai-Namco, BONES) write all bones along one axis, so that the rest pose is no figure at all.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.bvh.motion import BvhMotion

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
"""The fingers of `smplx52`, in its order."""


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
    fingers: Mapping[str, tuple[str, ...]]
    """Words of the joints of each finger, outwards; none where the tool has no fingers."""


def _conventions() -> Iterator[Convention]:
    """The rows of `tools.csv`, whose cells are words; `-` is a joint that the tool does not have.

    A word of a finger is one of `fingers`, in the order of `FINGERS`, and one of the `joints`, or of the
    `thumb`'s.
    """
    with Path(__file__).with_name("tools.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            tool = row.pop("tool")
            words = {key: tuple(word.strip("-") for word in cell.split()) for key, cell in row.items()}
            chains = zip(FINGERS, words["fingers"], [words["joints"]] * 4 + [words["thumb"]], strict=False)
            fingers = {finger: tuple(name + joint for joint in outwards) for finger, name, outwards in chains}
            yield Convention(tool, words["trunk"], words["neck"], words["leg"], words["arm"], fingers)


CONVENTIONS = tuple(_conventions())

_ENDS = ("end", "leaf", "nub", "site", "tip", "top")
_HANDLES = ("ctrl", "eff", "effector", "helper", "ik", "pole", "prop", "target", "weapon")
SPARE_WORDS = frozenset([*_ENDS, *_HANDLES, "eye", "jaw", "roll", "twist"])
"""A name with one of these words is no joint of the body: ends of chains, twist bones, handles."""
_HELPER = re.compile(r"(?:^|.*[:|/_])__(?=[^_])")
"""MakeHuman's `__UpLeg_L` is a helper above `UpLeg_L`."""

SIDE_WORDS = {"left": "left", "lft": "left", "l": "left", "right": "right", "rgt": "right", "r": "right"}


Side = Literal["left", "right", ""]

_NAMESPACE = re.compile(r".*[:|/]")
_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+")
_MOST = 0.6
"""Words that so large a share of all names begin or end with are the tool's prefix, and say nothing."""


@dataclass(frozen=True)
class JointName:
    """One joint's name, read."""

    side: Side
    word: str
    """Lower case, without side, prefix and punctuation: `upperarm`, `spine1`."""
    spare: bool
    """Whether it names the end of a chain, a twist bone or a handle."""


def read_names(joints: Sequence[str]) -> tuple[JointName, ...]:
    """Read the names of one skeleton; what most of them begin or end with is left out."""
    pieces = [_pieces(name) for name in joints]
    for end in (0, -1):
        while common := _common(pieces, end):
            trimmed = slice(1, None) if end == 0 else slice(None, -1)
            pieces = [p[trimmed] if len(p) > 1 and p[end] == common else p for p in pieces]
    read = map(_read, pieces)
    return tuple(
        replace(one, spare=one.spare or bool(_HELPER.match(name)))
        for one, name in zip(read, joints, strict=True)
    )


@cache
def vocabulary() -> frozenset[str]:
    """Every word of the table."""
    words = {word for known in CONVENTIONS for word in (*known.trunk, *known.neck, *known.leg, *known.arm)}
    for known in CONVENTIONS:
        words.update(word for chain in known.fingers.values() for word in chain)
    return frozenset(words - {""})


def _pieces(name: str) -> list[str]:
    """`DEF-upper_arm.L.001` -> def, upper, arm, l, 1."""
    found = _PIECE.findall(_NAMESPACE.sub("", name))
    return [piece.lstrip("0") or "0" if piece.isdigit() else piece.lower() for piece in found]


def _common(pieces: list[list[str]], end: int) -> str:
    """The word that most names have at one end beside others; empty when there is none."""
    counts = Counter(p[end] for p in pieces if len(p) > 1 and p[end] not in SIDE_WORDS)
    word, count = max(counts.items(), key=lambda item: item[1], default=("", 0))
    return word if count > _MOST * len(pieces) and len(pieces) > 2 else ""


def _read(pieces: list[str]) -> JointName:
    sides = {SIDE_WORDS[piece] for piece in pieces if piece in SIDE_WORDS}
    word = "".join(piece for piece in pieces if piece not in SIDE_WORDS)
    if not sides and word not in vocabulary():  # `lfemur`, `leftupleg`, `hipleft`: nothing stands between
        for side_word in sorted(SIDE_WORDS, key=len, reverse=True):
            cut = {word.removeprefix(side_word), word.removesuffix(side_word)} & vocabulary()
            if cut:
                sides, word = {SIDE_WORDS[side_word]}, cut.pop()
                break
    side: Side = ""
    if len(sides) == 1:
        side = "left" if "left" in sides else "right"
    return JointName(side, word, bool(SPARE_WORDS & set(pieces)))


POSES = 16
"""Frames looked at, spread over the clip [ours]."""

SAME_PLACE = 2e-3
"""Joints nearer to each other than this share of the figure's extent are one place (3 mm) [ours]."""


@dataclass(frozen=True)
class Figure:
    """Joints of one clip, its End Sites behind the others; parents come before children."""

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    poses: NDArray[np.float64]
    """Positions [K, N, 3] in some frames of the clip."""
    motion: BvhMotion
    """These frames."""

    @staticmethod
    def of(motion: BvhMotion) -> Figure:
        chosen = np.unique(np.linspace(0, motion.frames - 1, POSES).round().astype(int))
        few = replace(motion, values=motion.values[chosen])
        ended = few.with_ends()
        return Figure(ended.joints, ended.parents, ended.positions(), few)

    @cached_property
    def names(self) -> tuple[JointName, ...]:
        own = self.motion.joints
        return (*read_names(own), *[JointName("", "", True)] * (len(self.joints) - len(own)))

    def end_of(self, joint: int) -> int | None:
        """The End Site of a joint."""
        ends = range(len(self.motion.joints), len(self.joints))
        return next((end for end in ends if self.parents[end] == joint), None)

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """Children of every joint, spare ones left out."""
        found: list[list[int]] = [[] for _ in self.joints]
        for joint, parent in enumerate(self.parents):
            if parent >= 0 and not self.names[joint].spare:
                found[parent].append(joint)
        return tuple(tuple(joints) for joints in found)

    @cached_property
    def extent(self) -> float:
        """Largest side of the box around the figure, median over the poses."""
        return float(np.median(np.ptp(self.poses, axis=1).max(axis=-1)))

    def length(self, a: int, b: int) -> float:
        return float(np.median(np.linalg.norm(self.poses[:, a] - self.poses[:, b], axis=-1)))

    def coincide(self, a: int, b: int) -> bool:
        return self.length(a, b) < SAME_PLACE * self.extent

    def ancestors(self, joint: int) -> list[int]:
        """The joint, its parent, and so on to the root."""
        out = []
        while joint >= 0:
            out.append(joint)
            joint = self.parents[joint]
        return out

    def common_ancestor(self, joints: list[int]) -> int:
        shared = set.intersection(*(set(self.ancestors(joint)) for joint in joints))
        return max(shared, key=lambda joint: len(self.ancestors(joint)))

    def path(self, above: int, below: int) -> tuple[int, ...]:
        """Joints from `above` (left out) down to `below`; empty when it is not above it."""
        up = self.ancestors(below)
        return tuple(reversed(up[: up.index(above)])) if above in up else ()

    def apart(self, above: int, joints: tuple[int, ...]) -> tuple[int, ...]:
        """A path without the joints that lie on the one before them (or on `above`)."""
        out = [above]
        for joint in joints:
            if not self.coincide(joint, out[-1]):
                out.append(joint)
        return tuple(out[1:])
