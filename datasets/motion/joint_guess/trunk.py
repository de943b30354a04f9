"""Pelvis, spine, neck and head of a figure whose legs and arms are known: they lie between and above."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from motionloom.datasets.motion.joint_guess.conventions import CONVENTIONS
from motionloom.datasets.motion.joint_guess.figure import Figure
from motionloom.datasets.motion.joint_guess.limbs import How
from motionloom.datasets.motion.joint_guess.sides import LimbPair

_PELVIS_WORDS = frozenset(known.trunk[0] for known in CONVENTIONS)
_SPINE_WORDS = frozenset(word for known in CONVENTIONS for word in known.trunk[1:])
_NECK_WORDS = frozenset(known.neck[0] for known in CONVENTIONS)
_HEAD_WORDS = tuple(dict.fromkeys(known.neck[1] for known in CONVENTIONS))
"""Commonest first: the first that the figure has counts."""

_NEAR_HIPS = 0.4
"""The pelvis is within this share of a leg from the middle of the hips; a root on the floor is not [ours]."""


@dataclass
class Rows:
    """Source joints of target joints, how they were found, and where several could be meant."""

    sources: dict[str, tuple[int, ...]] = field(default_factory=dict)
    how: dict[str, How] = field(default_factory=dict)
    candidates: dict[str, tuple[int, ...]] = field(default_factory=dict)

    def put(self, joint: str, sources: Iterable[int], how: How) -> None:
        """`joint` is the mean of these; a source that appears twice weighs twice."""
        self.sources[joint], self.how[joint] = tuple(sources), how

    def doubt(self, joint: str, candidates: Iterable[int]) -> None:
        """`joint` may be any of these."""
        self.sources.pop(joint, None)
        self.candidates[joint] = tuple(candidates)


def fill_trunk(figure: Figure, legs: LimbPair, arms: LimbPair, rows: Rows) -> None:
    """Add pelvis, spine1 to spine3, neck and head."""
    pelvis = _pelvis(figure, legs, arms, rows)
    chest = figure.common_ancestor(arms.roots)
    spine = [j for j in figure.path(pelvis, chest) if not figure.names[j].spare]
    above: int | None = None
    if spine and "neck" in figure.names[chest].word:  # 3ds Max hangs the collars on the neck
        above, spine = chest, spine[:-1]
    _fill_spine(figure, pelvis, figure.apart(pelvis, tuple(spine)), rows)
    _fill_head(figure, chest, above, set(arms.roots), rows)


def _pelvis(figure: Figure, legs: LimbPair, arms: LimbPair, rows: Rows) -> int:
    """Where legs and spine branch, if it lies between the hips; else the joint of that name that does."""
    branch = figure.common_ancestor([*legs.roots, *arms.roots])
    hips = figure.poses[:, [legs.left.essential("leg")[0], legs.right.essential("leg")[0]]].mean(axis=1)
    hip, knee, ankle = legs.left.essential("leg")
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
    """Three of any number [ours]: the lowest, the middle and that of the collars; means where fewer."""
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
    """Neck (unless known) and head, on the chest's branch that carries no arm."""
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
