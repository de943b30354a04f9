"""Joint names read as words: side, what is left of the name, and whether it is a joint of the body at all."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from motionloom.datasets.motion.joint_guess.conventions import (
    CONVENTIONS,
    FINGERS,
    SIDE_WORDS,
    SPARE_WORDS,
)

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
    return tuple(_read(p) for p in pieces)


@cache
def vocabulary() -> frozenset[str]:
    """Every word of the table."""
    words = {word for known in CONVENTIONS for word in (*known.trunk, *known.neck, *known.leg, *known.arm)}
    for known in CONVENTIONS:
        if known.fingers is not None:
            words.update(word for finger in FINGERS for word in known.fingers.chain(finger))
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
    # `lfemur`: the letter of the side stands before a word without anything between.
    if not sides and word not in vocabulary() and word[:1] in ("l", "r") and word[1:] in vocabulary():
        sides, word = {SIDE_WORDS[word[0]]}, word[1:]
    side: Side = ""
    if len(sides) == 1:
        side = "left" if "left" in sides else "right"
    return JointName(side, word, bool(SPARE_WORDS & set(pieces)))
