"""Legs and arms of a figure: by the words of their names along a chain, else as mirrored branches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import Literal

from motionloom.datasets.motion.joint_guess.conventions import CONVENTIONS
from motionloom.datasets.motion.joint_guess.figure import Figure

Kind = Literal["leg", "arm"]
How = Literal["name", "hierarchy", "mean"]

_ESSENTIAL: dict[Kind, tuple[int, int, int]] = {"leg": (0, 1, 2), "arm": (1, 2, 3)}
"""Slots of the two long bones: hip, knee, ankle; shoulder, elbow, wrist. The fourth can be completed."""

_LONGER = 1.25
"""Both long bones of a limb are longer than every other bone of its chain by this factor [ours]."""
_ALIKE = 1.8
"""... and the one at most this many times the other (bones of people: below 1.3) [ours]."""
_MIRRORED = 0.1
"""Bones of mirrored limbs differ by less than this share of the longest one [ours]."""


@dataclass(frozen=True)
class Limb:
    """One limb: the source joint of each of its four slots, and how it was found."""

    slots: tuple[int | None, int | None, int | None, int | None]
    how: How
    rivals: tuple[tuple[int, ...], ...] = ((), (), (), ())
    """Per slot the joints between which the names do not decide."""

    def essential(self, kind: Kind) -> tuple[int, int, int]:
        """The three joints of the long bones."""
        first, second, third = (self.slots[slot] for slot in _ESSENTIAL[kind])
        assert first is not None and second is not None and third is not None
        return first, second, third


def named_limb(figure: Figure, kind: Kind, side: str) -> Limb | None:
    """The limb whose joints carry the words of a convention, in order along one chain."""
    words = [{getattr(known, kind)[slot] for known in CONVENTIONS} - {""} for slot in range(4)]
    fits: list[list[int | None]] = [[None] for _ in range(4)]
    for joint, name in enumerate(figure.names):
        for slot in range(4):
            if name.side == side and not name.spare and name.word in words[slot]:
                fits[slot].append(joint)
    best: list[tuple[int | None, ...]] = []
    top = (0, 0)
    for choice in product(*fits):
        joints = [joint for joint in choice if joint is not None]
        if any(choice[slot] is None for slot in _ESSENTIAL[kind]) or len(set(joints)) < len(joints):
            continue
        if any(a not in figure.ancestors(b) for a, b in pairwise(joints)):
            continue
        score = (len(joints), _agreement(figure, kind, choice))
        if score >= top:
            best = [*best, choice] if score == top else [choice]
            top = score
    if not best:
        return None
    fitting = [{one for fit in best if (one := fit[slot]) is not None} for slot in range(4)]
    rivals = tuple(tuple(sorted(joints)) if len(joints) > 1 else () for joints in fitting)
    a, b, c, d = best[0]
    return Limb((a, b, c, d), "name", rivals)


def _agreement(figure: Figure, kind: Kind, choice: tuple[int | None, ...]) -> int:
    """In how many slots one and the same convention has the words."""
    words = ["" if joint is None else figure.names[joint].word for joint in choice]
    rows: list[tuple[str, ...]] = [getattr(known, kind) for known in CONVENTIONS]
    return max(sum(a == b for a, b in zip(words, row, strict=True)) for row in rows)


@dataclass(frozen=True)
class MirroredPair:
    """Two branches of one joint that have the same bones, two of them long: a pair of legs or arms."""

    at: int
    chains: tuple[tuple[int, ...], tuple[int, ...]]
    first: int
    """Where in the chains the first long bone begins."""
    long: float
    """Length of both long bones together."""

    def limb(self, kind: Kind, branch: int) -> Limb:
        """One of the two as a limb; its fourth slot is the neighbour on the chain, if there is one."""
        chain, at = self.chains[branch], self.first
        a, b, c = chain[at : at + 3]
        if kind == "arm":
            return Limb((chain[at - 1] if at else None, a, b, c), "hierarchy")
        return Limb((a, b, c, None), "hierarchy")


def mirrored_pairs(figure: Figure, taken: set[int]) -> list[MirroredPair]:
    """Pairs of limbs outside the branches of `taken` joints, a pair inside another one's branch left out."""
    found: list[MirroredPair] = []
    inside: set[int] = set(taken)
    for joint in range(len(figure.joints)):  # parents first
        parent = figure.parents[joint]
        if parent in inside:
            inside.add(joint)
        if joint in inside:
            continue
        for pair in _pairs_at(figure, joint):
            if not inside & {chain[0] for chain in pair.chains}:
                found.append(pair)
                inside.update(chain[0] for chain in pair.chains)
    return found


def _pairs_at(figure: Figure, joint: int) -> Iterator[MirroredPair]:
    chains = [figure.main_chain(child) for child in figure.children[joint]]
    for one, other in combinations(chains, 2):
        lengths = [[figure.length(a, b) for a, b in pairwise(c)] for c in (one, other)]
        first = _long_bones(lengths[0])
        if first is None or len(one) != len(other) or first != _long_bones(lengths[1]):
            continue
        slack = _MIRRORED * max(lengths[0])
        if all(abs(a - b) < slack for a, b in zip(*lengths, strict=True)):
            yield MirroredPair(joint, (one, other), first, sum(lengths[0][first : first + 2]))


def _long_bones(lengths: list[float]) -> int | None:
    """Where two neighbouring bones begin that are longer than all others of a chain."""
    for first in range(len(lengths) - 1):
        pair, rest = lengths[first : first + 2], lengths[:first] + lengths[first + 2 :]
        if min(pair) > _LONGER * max(rest, default=0.0) and max(pair) < _ALIKE * min(pair):
            return first
    return None
