"""Which side of a figure is its left: legs and arms as pairs, checked against the pose.

A foot points forward of its shin, however the leg is lifted. So shin upwards x foot forwards is left, in any
unit and whichever axis is up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.joint_guess.figure import Figure
from motionloom.datasets.motion.joint_guess.limbs import Kind, Limb, MirroredPair, mirrored_pairs, named_limb

CLEAR = 0.2
"""Cosine with the left of the pose from which on the pose speaks for or against a side [ours]."""


@dataclass(frozen=True)
class LimbPair:
    """The two limbs of one kind."""

    kind: Kind
    left: Limb
    right: Limb
    sides_named: bool
    """Whether the names say which is which."""

    @property
    def swapped(self) -> LimbPair:
        """The same, with left and right exchanged."""
        return replace(self, left=self.right, right=self.left)

    @property
    def roots(self) -> list[int]:
        """The first joint of either limb."""
        chains = [[joint for joint in limb.slots if joint is not None] for limb in (self.left, self.right)]
        return [chain[0] for chain in chains]


def find_pairs(figure: Figure) -> tuple[LimbPair | None, LimbPair | None]:
    """Legs and arms, each by names where both sides have them, else by the tree."""
    legs, arms = _named_pair(figure, "leg"), _named_pair(figure, "arm")
    if legs is None or arms is None:
        taken = {root for pair in (legs, arms) if pair is not None for root in pair.roots}
        found = mirrored_pairs(figure, taken)
        choices = [
            (low, high)
            for low in (found if legs is None else [None])
            for high in (found if arms is None else [None])
            if _stacked(figure, _bottom(figure, low, legs), _bottom(figure, high, arms))
            and (low is None or high is None or low.long > high.long)
        ]
        if len(choices) == 1:
            low, high = choices[0]
            legs = legs if low is None else _tree_pair(figure, "leg", low)
            arms = arms if high is None else _tree_pair(figure, "arm", high)
    return legs, arms


def handedness(figure: Figure, pair: LimbPair, legs: LimbPair) -> float:
    """How far the left of `pair` is on the left of the pose: 1 fully, -1 on the right; 0 where it is open."""
    hinges = []
    for limb in (legs.left, legs.right):
        _, knee, ankle, toe = limb.slots
        if knee is None or ankle is None or toe is None:
            return 0.0
        hinges.append(np.cross(_bone(figure, ankle, knee), _bone(figure, ankle, toe)))
    one, other = pair.left.essential(pair.kind)[0], pair.right.essential(pair.kind)[0]
    return float(np.mean(np.sum(np.stack(hinges) * _bone(figure, other, one), axis=-1)))


def _named_pair(figure: Figure, kind: Kind) -> LimbPair | None:
    left, right = (named_limb(figure, kind, side) for side in ("left", "right"))
    return None if left is None or right is None else LimbPair(kind, left, right, True)


def _tree_pair(figure: Figure, kind: Kind, pair: MirroredPair) -> LimbPair:
    """A pair found in the tree; sides by the names if all of them that have one agree."""
    one, other = pair.limb(kind, 0), pair.limb(kind, 1)
    sides = [{figure.names[j].side for j in limb.essential(kind)} - {""} for limb in (one, other)]
    found = LimbPair(kind, one, other, sides in ([{"left"}, {"right"}], [{"right"}, {"left"}]))
    return found.swapped if sides == [{"right"}, {"left"}] else found


def _bottom(figure: Figure, pair: MirroredPair | None, known: LimbPair | None) -> int:
    """The joint that both limbs hang on."""
    if pair is not None:
        return pair.at
    assert known is not None
    return figure.common_ancestor(known.roots)


def _stacked(figure: Figure, below: int, above: int) -> bool:
    """Whether legs at `below` and arms at `above` fit: the spine goes from the one to the other."""
    return below != above and below in figure.ancestors(above)


def _bone(figure: Figure, start: int, end: int) -> NDArray[np.float64]:
    """Direction [K, 3] from one joint to another."""
    vectors = figure.poses[:, end] - figure.poses[:, start]
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    out: NDArray[np.float64] = vectors / np.where(lengths > 0, lengths, 1.0)
    return out
