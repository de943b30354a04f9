"""Fingers of a figure whose wrists are known, by name alone: too many hands have four joints a finger."""

from __future__ import annotations

from itertools import pairwise

from motionloom.datasets.motion.joint_guess.conventions import CONVENTIONS, FINGERS
from motionloom.datasets.motion.joint_guess.figure import Figure
from motionloom.datasets.motion.joint_guess.limbs import Limb
from motionloom.datasets.motion.joint_guess.trunk import Rows


def fill_fingers(figure: Figure, side: str, arm: Limb, rows: Rows) -> None:
    """Add the three joints of each finger of a hand; those of a finger that is not there stay missing."""
    wrist = arm.essential("arm")[2]
    below: dict[str, list[int]] = {}
    for joint, name in enumerate(figure.names):
        if name.side == side and not name.spare and wrist in figure.ancestors(joint):
            below.setdefault(name.word, []).append(joint)
    for finger in FINGERS:
        chain = _knuckles(figure, wrist, finger, _chain(finger, below))
        for number, joint in enumerate(chain, start=1):
            rows.put(f"{side}_{finger}{number}", [joint], "name")


def _chain(finger: str, below: dict[str, list[int]]) -> list[int]:
    """The finger's joints outwards, in the words of the convention that has most of them."""
    chains = [
        [joint for word in known.fingers.chain(finger) for joint in below.get(word, [])]
        for known in CONVENTIONS
        if known.fingers is not None
    ]
    return max(chains, key=len)


def _knuckles(figure: Figure, wrist: int, finger: str, chain: list[int]) -> list[int]:
    """The knuckle and the two joints after it; none if the chain is no chain or too short."""
    if len(chain) < 3 or any(a not in figure.ancestors(b) for a, b in pairwise(chain)):
        return []
    # Four joints begin in the palm (SOMA) or end at the tip (Mixamo). The bone in the palm is the longest.
    in_palm = figure.length(chain[0], chain[1]) > figure.length(wrist, chain[0])
    first = int(len(chain) > 3 and finger != "thumb" and in_palm)
    return chain[first : first + 3]
