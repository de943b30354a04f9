"""Joints of a figure: legs and arms by the words of their names along a chain, then feet and fingers below
them, and the trunk between and above them.

The fourth joint of a leg, the ball of the foot, is below the ankle where no name says it, or at its End Site,
or estimated: an estimate stands at right angles to the shin, forward of the hips, as far away as in our own
skeleton, and is written into the joint map as an End Site of the ankle.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import pairwise, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.bvh.joint_guess.figure import CONVENTIONS, FINGERS, Figure
from motionloom.datasets.motion.skeleton import Skeleton

Kind = Literal["leg", "arm"]
How = Literal["name", "hierarchy", "mean", "end", "estimate"]

_ESSENTIAL: dict[Kind, tuple[int, int, int]] = {"leg": (0, 1, 2), "arm": (1, 2, 3)}
"""Slots of the two long bones: hip, knee, ankle; shoulder, elbow, wrist. The fourth can be completed."""


@dataclass(frozen=True)
class Limb:
    """One limb: the source joint of each of its four slots."""

    kind: Kind
    side: str
    slots: tuple[int | None, ...]
    rivals: tuple[tuple[int, ...], ...]
    """Per slot the joints between which the names do not decide."""

    def essential(self) -> tuple[int, int, int]:
        first, second, third = (self.slots[slot] for slot in _ESSENTIAL[self.kind])
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
    # Every choice of joints along one chain is tried: one word may mean two joints, and only the other words
    # of its chain tell which. Complete limbs win, then those that most agree with one tool's naming.
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
    return Limb(kind, side, best[0], rivals)


def _agreement(figure: Figure, kind: Kind, choice: tuple[int | None, ...]) -> int:
    """Count the slots in which one and the same convention has the words."""
    words = ["" if joint is None else figure.names[joint].word for joint in choice]
    rows: list[tuple[str, ...]] = [getattr(known, kind) for known in CONVENTIONS]
    return max(sum(a == b for a, b in zip(words, row, strict=True)) for row in rows)


Limbs = tuple[Limb, Limb]
"""The left one and the right one."""


def named_limbs(figure: Figure, kind: Kind) -> Limbs | None:
    """The legs or arms, where both sides have their names."""
    left, right = (named_limb(figure, kind, side) for side in ("left", "right"))
    return None if left is None or right is None else (left, right)


def roots(limbs: Iterable[Limb]) -> list[int]:
    """The first joint of each."""
    return [next(joint for joint in limb.slots if joint is not None) for limb in limbs]


_PELVIS_WORDS = frozenset(known.trunk[0] for known in CONVENTIONS)
_SPINE_WORDS = frozenset(word for known in CONVENTIONS for word in known.trunk[1:])
_NECK_WORDS = frozenset(known.neck[0] for known in CONVENTIONS)
_HEAD_WORDS = tuple(dict.fromkeys(known.neck[1] for known in CONVENTIONS))
"""Commonest first: the first that the figure has counts."""

_NEAR_HIPS = 0.4
"""The pelvis is within this share of a leg from the middle of the hips; a root on the floor is not [ours]."""


@dataclass
class Rows:
    """Source joints of target joints, how they were found, and the candidates where it is not certain."""

    sources: dict[str, tuple[int, ...]] = field(default_factory=dict)
    how: dict[str, How] = field(default_factory=dict)
    candidates: dict[str, tuple[int, ...]] = field(default_factory=dict)
    ends: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """Estimated End Sites of joints, in multiples of the distance from their parents."""

    def put(self, joint: str, sources: Iterable[int], how: How) -> None:
        """Let `joint` be the mean of `sources`, of which one that appears twice weighs twice; with `estimate`
        it is the estimated End Site of its source.
        """
        self.sources[joint], self.how[joint] = tuple(sources), how

    def doubt(self, joint: str, candidates: Iterable[int]) -> None:
        self.sources.pop(joint, None)
        self.candidates[joint] = tuple(candidates)


def fill_trunk(figure: Figure, legs: Limbs, arms: Limbs, rows: Rows) -> None:
    """Add pelvis, spine1 to spine3, neck and head."""
    pelvis = _pelvis(figure, legs, arms, rows)
    chest = figure.common_ancestor(roots(arms))
    spine = [j for j in figure.path(pelvis, chest) if not figure.names[j].spare]
    above: int | None = None
    if spine and "neck" in figure.names[chest].word:  # 3ds Max hangs the collars on the neck
        above, spine = chest, spine[:-1]
    _fill_spine(figure, pelvis, figure.apart(pelvis, tuple(spine)), rows)
    _fill_head(figure, chest, above, set(roots(arms)), rows)


def _pelvis(figure: Figure, legs: Limbs, arms: Limbs, rows: Rows) -> int:
    """Return the joint where legs and spine branch if it lies between the hips, else a joint of that name."""
    branch = figure.common_ancestor(roots([*legs, *arms]))
    hips = figure.poses[:, [leg.essential()[0] for leg in legs]].mean(axis=1)
    hip, knee, ankle = legs[0].essential()
    reach = _NEAR_HIPS * (figure.length(hip, knee) + figure.length(knee, ankle))
    named = [j for j, name in enumerate(figure.names) if name.word in _PELVIS_WORDS and not name.side]
    fits = [
        j
        for j in dict.fromkeys([branch, *named])
        if np.median(np.linalg.norm(figure.poses[:, j] - hips, axis=-1)) < reach
    ]
    if fits[:1] == [branch] or len(fits) == 1:
        how: How = "name" if fits[0] in named else "hierarchy"
        rows.put("pelvis", fits[:1], how)
        return fits[0]
    rows.doubt("pelvis", fits or [branch])
    return branch


def _fill_spine(figure: Figure, pelvis: int, spine: tuple[int, ...], rows: Rows) -> None:
    """Add three of any number of spine joints [ours]: the lowest, the middle and that of the collars."""
    if not spine:
        return
    middle = spine[(len(spine) - 1) // 2 : len(spine) // 2 + 1]
    by_count = {
        1: ((pelvis, pelvis, spine[0]), (pelvis, spine[0], spine[0]), spine),
        2: ((pelvis, spine[0]), spine[:1], spine[1:]),
    }
    chosen = by_count.get(len(spine), (spine[:1], middle, spine[-1:]))
    for joint, sources in zip(("spine1", "spine2", "spine3"), chosen, strict=True):
        named = figure.names[sources[0]].word in _SPINE_WORDS
        rows.put(joint, sources, "mean" if len(sources) > 1 else "name" if named else "hierarchy")


def _fill_head(figure: Figure, chest: int, neck: int | None, arms: set[int], rows: Rows) -> None:
    """Add neck (unless known) and head, on the chest's branch that carries no arm."""
    limbs = {figure.path(chest, arm)[0] for arm in arms if arm != chest}
    branches = [child for child in figure.children[chest] if child not in limbs]
    head = _named_head(figure, branches)
    if head is not None:
        chain = [j for j in figure.path(chest, head) if not figure.names[j].spare]
        necks = [*figure.apart(chest, tuple(chain[:-1]))]
        rows.put("head", [head], "name")
    else:
        chain = list(figure.apart(chest, _single_file(figure, branches)))
        # A nameless neck and head are certain when they are all there is: of three, any two could be meant.
        if len(chain) != (2 if neck is None else 1):
            rows.doubt("head", chain or branches)
            if neck is None:
                rows.doubt("neck", chain or branches)
            necks = []
        else:
            necks = chain[:-1]
            rows.put("head", chain[-1:], "hierarchy")
    if neck is not None:
        rows.put("neck", [neck], "name")
    elif necks:
        named = [j for j in necks if figure.names[j].word in _NECK_WORDS]
        rows.put("neck", (named or necks)[:1], "name" if named else "hierarchy")
    elif head is not None:
        rows.put("neck", [chest, head, head], "mean")


def _named_head(figure: Figure, branches: list[int]) -> int | None:
    above = [j for j in range(len(figure.joints)) if set(branches) & set(figure.ancestors(j))]
    for word in _HEAD_WORDS:
        fits = [j for j in above if figure.names[j].word == word and not figure.names[j].spare]
        if fits:
            return fits[0] if len(fits) == 1 else None
    return None


def _single_file(figure: Figure, branches: list[int]) -> tuple[int, ...]:
    """The joints from the only branch on, up to the first that branches itself; none for several branches."""
    out: list[int] = []
    while len(branches) == 1:
        out.append(branches[0])
        branches = list(figure.children[branches[0]])
    return tuple(out)


def fill_fingers(figure: Figure, arm: Limb, rows: Rows) -> None:
    """Add the three joints of each finger, by name alone: too many hands have four joints a finger."""
    side, wrist = arm.side, arm.essential()[2]
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
        [joint for word in known.fingers.get(finger, ()) for joint in below.get(word, [])]
        for known in CONVENTIONS
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


_NAMED = Skeleton.named("smpl22")
_BALL = _NAMED.offsets[_NAMED.index("left_foot")]
_SHIN = float(np.linalg.norm(_NAMED.offsets[_NAMED.index("left_ankle")]))
_FORWARD, _DOWN = float(_BALL[2]) / _SHIN, -float(_BALL[1]) / _SHIN
"""From the ankle to the ball of the foot, in lengths of the shin."""
_FOOT = (0.12, 0.75)
"""Distance of a foot's End Site from the ankle in lengths of the shin: a ball to a long shoe [ours]."""
_AHEAD = 0.5
"""Cosine between the way to it and forward that it has at least: others point down, or back to a heel."""


def with_feet(figure: Figure, legs: Limbs, rows: Rows) -> Limbs:
    """The legs with their fourth slot, where it is certain; a row for every foot or a doubt."""
    completed, open_legs = [], 0
    for leg in legs:
        ankle, toe = leg.slots[2], leg.slots[3]
        assert ankle is not None
        below = figure.children[ankle]
        while toe is None and len(below) == 1:
            toe = None if figure.coincide(below[0], ankle) else below[0]
            below = figure.children[below[0]]
        if toe is not None and leg.slots[3] is None:
            rows.put(f"{leg.side}_foot", [toe], "hierarchy")
        elif toe is None and below:
            rows.doubt(f"{leg.side}_foot", below)
        open_legs += toe is None and not below
        completed.append(replace(leg, slots=(*leg.slots[:3], toe)))
    # An estimate is for figures without any foot joint: of two feet, one open is rather a wrong name.
    if open_legs == len(completed):
        _end_feet(figure, legs, rows)
    else:
        for leg in completed:
            if leg.slots[3] is None and f"{leg.side}_foot" not in rows.candidates:
                rows.doubt(f"{leg.side}_foot", ())
    return completed[0], completed[1]


def _end_feet(figure: Figure, legs: Limbs, rows: Rows) -> None:
    """Add rows for both feet: their End Sites where both are feet, else the estimates."""
    hips = [figure.poses[:, leg.essential()[0]] for leg in legs]
    ends = []
    for leg in legs:
        _, knee, ankle = (figure.poses[:, joint] for joint in leg.essential())
        shin = figure.length(*leg.essential()[1:])
        forward = _unit(np.cross(hips[0] - hips[1], knee - ankle))
        end = figure.end_of(leg.essential()[2])
        if end is not None:
            way = figure.poses[:, end] - ankle
            length = np.median(np.linalg.norm(way, axis=-1)) / shin
            ahead = np.median(np.sum(_unit(way) * forward, axis=-1))
            ends.append(end if _FOOT[0] < length < _FOOT[1] and ahead > _AHEAD else None)
        ball = _FORWARD * forward + _DOWN * _unit(ankle - knee)
        local = np.einsum("tji,tj->ti", _turned(figure, leg), ball).mean(axis=0)
        share = shin / figure.length(figure.parents[leg.essential()[2]], leg.essential()[2])
        x, y, z = (local * (share * np.hypot(_FORWARD, _DOWN) / np.linalg.norm(local))).tolist()
        rows.ends[leg.essential()[2]] = (x, y, z)
    found = [end for end in ends if end is not None]
    for number, leg in enumerate(legs):
        if len(found) == len(legs):
            rows.ends.clear()
            rows.put(f"{leg.side}_foot", [found[number]], "end")
        else:
            rows.put(f"{leg.side}_foot", [leg.essential()[2]], "estimate")


def _turned(figure: Figure, leg: Limb) -> NDArray[np.float64]:
    """Rotations [K, 3, 3] of the ankle in the world, in every pose."""
    chain = figure.ancestors(leg.essential()[2])[::-1]
    turns: NDArray[np.float64] = reduce(np.matmul, figure.motion.local_rotations(chain))
    return turns


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
