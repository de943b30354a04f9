"""Joint names of common tools (`tools.csv`), and a skeleton's joints found by such names.

To know another tool, add a row. Words are what is left of a name: no side, prefix, punctuation, capitals or
leading zeros, so `mixamorig:LeftUpLeg` is `upleg`, `DEF-upper_arm.L` is `upperarm` and `neck_01` is `neck1`.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
"""The fingers of `smplx52`, in its order."""


@dataclass(frozen=True)
class Convention:
    """Words of one tool's skeleton; an empty word is a joint that it does not have."""

    neck: tuple[str, ...]
    """Neck, head."""
    leg: tuple[str, ...]
    """Hip, knee, ankle, ball of the foot."""
    arm: tuple[str, ...]
    """Collar, shoulder, elbow, wrist."""
    fingers: Mapping[str, tuple[str, ...]]
    """Words of the joints of each finger, outwards; none where the tool has no fingers of its own words."""

    def words(self) -> Iterator[str]:
        yield from (*self.neck, *self.leg, *self.arm)
        for chain in self.fingers.values():
            yield from chain


def _conventions() -> Iterator[Convention]:
    """The rows of `tools.csv`, whose cells are words; `-` is a joint that the tool does not have.

    A word of a finger is one of `fingers`, in the order of `FINGERS`, and one of the `joints`, or of the
    `thumb`'s.
    """
    with Path(__file__).with_name("tools.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            words = {key: tuple(word.strip("-") for word in cell.split()) for key, cell in row.items()}
            chains = zip(FINGERS, words["fingers"], [words["joints"]] * 4 + [words["thumb"]], strict=False)
            fingers = {finger: tuple(name + joint for joint in outwards) for finger, name, outwards in chains}
            yield Convention(words["neck"], words["leg"], words["arm"], fingers)


CONVENTIONS = tuple(_conventions())
WORDS = {word for known in CONVENTIONS for word in known.words()}
ENDS = ("end", "nub", "tip", "top")
"""Words of the ends of chains, which are no joints of the body."""
_SIDES = {
    "left": "left", "lft": "left", "lt": "left", "l": "left", "左": "left",
    "right": "right", "rgt": "right", "rt": "right", "r": "right", "右": "right",
}  # fmt: skip
_MIDDLE = ("m", "c")
"""Maya's `Head_M` and Unreal's `head_c` are of no side."""

_NAMESPACE = re.compile(r"[:|/]")
_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+")
_HELPER = re.compile(r"(^|_)__[^_]")
"""MakeHuman's `__UpLeg_L` is a helper above `UpLeg_L`."""
_MOST = 0.6
"""Words that so large a share of all names begin or end with are the tool's prefix, and say nothing."""


def read_names(joints: Sequence[str]) -> list[tuple[str, str]]:
    """Side (`left`, `right` or empty) and word of every joint; no word for helpers."""
    names = [_NAMESPACE.split(name)[-1] for name in joints]
    pieces = [_pieces(name) for name in names]
    for end, trimmed in ((0, slice(1, None)), (-1, slice(None, -1))):
        while common := _common(pieces, end):
            pieces = [
                piece[trimmed] if len(piece) > 1 and piece[end] == common else piece for piece in pieces
            ]
    return [
        ("", "") if _HELPER.search(name) else _read(piece) for name, piece in zip(names, pieces, strict=True)
    ]


def _pieces(name: str) -> list[str]:
    """`DEF-upper_arm.L.001` -> def, upper, arm, l, 1."""
    return [
        piece.lstrip("0") or "0" if piece.isdecimal() else piece.lower() for piece in _PIECE.findall(name)
    ]


def _common(pieces: list[list[str]], end: int) -> str:
    """The word that most names have at one end beside others; empty when there is none."""
    counts = Counter(p[end] for p in pieces if len(p) > 1 and p[end] not in _SIDES)
    word, count = max(counts.items(), key=lambda item: item[1], default=("", 0))
    return word if count > _MOST * len(pieces) and len(pieces) > 2 else ""


def _read(pieces: list[str]) -> tuple[str, str]:
    """Side and word of one name."""
    sides = {_SIDES[piece] for piece in pieces if piece in _SIDES}
    word = "".join(piece for piece in pieces if piece not in _SIDES and piece not in _MIDDLE)
    if not sides and word not in WORDS:  # `lfemur`, `leftupleg`, `hipleft`: nothing stands between
        for side_word in sorted(_SIDES, key=len, reverse=True):
            if cut := {word.removeprefix(side_word), word.removesuffix(side_word)} & WORDS:
                return _SIDES[side_word], cut.pop()
    return (sides.pop() if len(sides) == 1 else ""), word
