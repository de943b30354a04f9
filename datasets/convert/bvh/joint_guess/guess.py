"""Guess the joint map of any figure: names first, checked and completed by its tree.

1. Legs and arms by the words of their names along a chain (`limbs.py`), their feet also at End
   Sites.
2. Pelvis, spine, neck and head between and above them, fingers below the wrists.
3. A joint that is missing between two others is a mean of its neighbours.

What is not certain is not guessed: the row stays empty, with what it could be. All of it is [ours]. Whether
the names tell the truth is seen when the clips are: a figure whose left is on its right has feet that point
backwards (`datasets/motion/plausibility.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from motionloom.datasets.convert.bvh.joint_guess.figure import Figure
from motionloom.datasets.convert.bvh.joint_guess.limbs import (
    How,
    Kind,
    Limb,
    Limbs,
    Rows,
    fill_fingers,
    fill_trunk,
    named_limbs,
    roots,
    with_feet,
)
from motionloom.datasets.motion.bvh.joint_map import JointMap, map_text
from motionloom.datasets.motion.bvh.motion import END, BvhMotion
from motionloom.datasets.motion.skeleton import Skeleton


@dataclass(frozen=True)
class GuessedJoint:
    """One row: a joint of the target and its sources."""

    joint: str
    sources: tuple[str, ...]
    """Source joints whose mean is taken, a repeated one weighing more; none in a row to be filled in."""
    how: How | Literal["missing"]
    candidates: tuple[str, ...] = ()
    """Joints that it could be, where it is not certain."""


@dataclass(frozen=True)
class JointGuess:
    """A guessed joint map."""

    source: str
    """The clip it was made from."""
    target: Skeleton
    rows: tuple[GuessedJoint, ...]
    """One for every joint of the target."""
    unmapped: tuple[str, ...]
    """Source joints that stand for nothing."""
    problems: tuple[str, ...]
    """Contradictions to the rows, each a clause."""
    ends: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Estimated End Sites, as in a joint map."""

    @property
    def open_rows(self) -> tuple[GuessedJoint, ...]:
        return tuple(row for row in self.rows if not row.sources)

    @property
    def certain(self) -> bool:
        """Whether it may be used without anyone looking at it."""
        return not self.open_rows and not self.problems

    def joint_map(self, where: str) -> JointMap:
        """The map, if it is certain; errors name it `where`."""
        if not self.certain:
            raise ValueError(f"{self.source}: the guess is not certain: {self.doubts()}")
        rows = tuple(row.sources for row in self.rows)
        return JointMap(where, self.target, rows, self.unmapped, ends=self.ends)

    def summary(self) -> str:
        """Return one line that counts how the joints were found."""
        counts: Counter[str] = Counter(row.how for row in self.rows)
        kinds = {
            "name": "by name", "hierarchy": "by hierarchy", "mean": "as means", "end": "at End Sites",
            "estimate": "estimated (the feet)", "missing": "open",
        }  # fmt: skip
        found = ", ".join(f"{counts[how]} {text}" for how, text in kinds.items() if counts[how])
        return f"{found}; {len(self.unmapped)} of the source's joints stand for nothing"

    def doubts(self) -> str:
        """Return what is not certain as a sentence without its full stop; empty when all is."""
        rows = [
            f"{row.joint} ({' or '.join(row.candidates[:4])}?)" if row.candidates else row.joint
            for row in self.open_rows
        ]
        shown = ", ".join(rows[:8]) + (f" and {len(rows) - 8} more" if len(rows) > 8 else "")
        return "; ".join([*self.problems, *([f"no certain joint for {shown}"] if rows else [])])

    def text(self, skeleton: str) -> str:
        """The map file, for files of `skeleton` alone."""
        note = f"guessed: {self.summary()}"
        if not self.certain:
            todo = "Fill in the rows that say null" if self.open_rows else "Correct the rows"
            note += f". NOT CERTAIN: {self.doubts()}. {todo}"
        sources: list[tuple[str, ...] | None] = [row.sources or None for row in self.rows]
        candidates = {row.joint: list(row.candidates) for row in self.open_rows if row.candidates}
        more = {key: dict(value) for key, value in (("candidates", candidates), ("ends", self.ends)) if value}
        return map_text(self.target, sources, note=note, unmapped=self.unmapped, skeleton=skeleton, **more)


_SLOTS: dict[Kind, tuple[str, str, str, str]] = {
    "leg": ("hip", "knee", "ankle", "foot"),
    "arm": ("collar", "shoulder", "elbow", "wrist"),
}


def guess_joint_map(motion: BvhMotion, target: Skeleton) -> JointGuess:
    """Guess which joints of a clip stand for those of `target` (`smpl22` or `smplx52`)."""
    figure, rows = Figure.of(motion), Rows()
    legs, arms = named_limbs(figure, "leg"), named_limbs(figure, "arm")
    problems: list[str] = []
    if legs is None or arms is None:
        kinds = [kind for kind, pair in (("legs", legs), ("arms", arms)) if pair is None]
        problems.append(f"found no {' and no '.join(kinds)} by name")
        _fill_limbs(legs or arms, rows)
    else:
        legs = with_feet(figure, legs, rows)
        fill_trunk(figure, legs, arms, rows)
        _fill_limbs((*legs, *arms), rows)
        _fill_collars(figure, arms, rows)
        for arm in arms:
            fill_fingers(figure, arm, rows)
    return _guess(figure, motion.name, target, rows, problems)


def _fill_limbs(limbs: Iterable[Limb] | None, rows: Rows) -> None:
    for limb in limbs or ():
        for word, joint, rivals in zip(_SLOTS[limb.kind], limb.slots, limb.rivals, strict=True):
            name = f"{limb.side}_{word}"
            if rivals:
                rows.doubt(name, rivals)
            elif joint is not None and name not in rows.sources:
                rows.put(name, [joint], "name")


def _fill_collars(figure: Figure, arms: Limbs, rows: Rows) -> None:
    """Add collars without a name: the only joint between chest and shoulder, else a mean of neighbours."""
    chest = figure.common_ancestor(roots(arms))
    for arm in arms:
        shoulder, collar = arm.essential()[0], f"{arm.side}_collar"
        if collar in rows.sources or collar in rows.candidates:
            continue
        between = figure.apart(chest, figure.path(chest, shoulder))[:-1]
        if len(between) == 1:
            rows.put(collar, between, "hierarchy")
        elif between:
            rows.doubt(collar, between)
        else:  # our collar lies in the middle of these three to 2 cm
            rows.put(collar, [chest, *rows.sources.get("neck", ())[:1], shoulder], "mean")


def _guess(figure: Figure, source: str, target: Skeleton, rows: Rows, problems: list[str]) -> JointGuess:
    def named(joints: tuple[int, ...]) -> tuple[str, ...]:
        return tuple(figure.joints[joint] for joint in joints)

    guessed = []
    for joint in target.joints:
        how = rows.how[joint] if joint in rows.sources else "missing"
        candidates = named(rows.candidates.get(joint, ()))
        sources = named(rows.sources.get(joint, ()))
        sources = tuple(map(END.format, sources)) if how == "estimate" else sources
        guessed.append(GuessedJoint(joint, sources, how, candidates))
    used = {name for row in guessed for name in row.sources}
    counts = Counter(figure.joints)
    twice = sorted(name for name in used if counts[name] > 1)
    if twice:
        problems.append(f"{', '.join(twice)}: two joints of one name")
    unmapped = tuple(name for name in dict.fromkeys(figure.motion.joints) if name not in used)
    ends = {figure.joints[joint]: offset for joint, offset in rows.ends.items()}
    return JointGuess(source, target, tuple(guessed), unmapped, tuple(problems), ends)
