"""What a guess says: the rows, how each was found, what is open, and the map file to use or to fill in."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

from motionloom.datasets.motion.joint_guess.limbs import How
from motionloom.datasets.motion.joint_map import JointMap, map_text
from motionloom.datasets.motion.skeleton import Skeleton


@dataclass(frozen=True)
class GuessedJoint:
    """One row: a joint of the target and what stands for it."""

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
    """What contradicts the rows, each a clause."""

    @property
    def open_rows(self) -> tuple[GuessedJoint, ...]:
        """Rows that are to be filled in."""
        return tuple(row for row in self.rows if not row.sources)

    @property
    def certain(self) -> bool:
        """Whether it may be used without anyone looking at it."""
        return not self.open_rows and not self.problems

    def joint_map(self, where: str) -> JointMap:
        """The map, if it is certain; errors name it `where`."""
        if not self.certain:
            raise ValueError(f"{self.source}: the guess is not certain: {self.doubts()}")
        return JointMap(where, self.target, tuple(row.sources for row in self.rows), self.unmapped)

    def summary(self) -> str:
        """How the joints were found, in one line."""
        counts: Counter[str] = Counter(row.how for row in self.rows)
        kinds = {"name": "by name", "hierarchy": "by hierarchy", "mean": "as means", "missing": "open"}
        found = ", ".join(f"{counts[how]} {text}" for how, text in kinds.items() if counts[how])
        return f"{found}; {len(self.unmapped)} of the source's joints stand for nothing"

    def doubts(self) -> str:
        """What is not certain, in one sentence without its full stop; empty when all is."""
        rows = [
            f"{row.joint} ({' or '.join(row.candidates[:4])}?)" if row.candidates else row.joint
            for row in self.open_rows
        ]
        shown = ", ".join(rows[:8]) + (f" and {len(rows) - 8} more" if len(rows) > 8 else "")
        return "; ".join([*self.problems, *([f"no certain joint for {shown}"] if rows else [])])

    def text(self) -> str:
        """The map file, to be filled in or corrected by hand."""
        note = f"guessed from {self.source}: {self.summary()}"
        if not self.certain:
            todo = "Fill in the rows that say null" if self.open_rows else "Correct the rows"
            note += f". NOT CERTAIN: {self.doubts()}. {todo}"
        sources: list[tuple[str, ...] | None] = [row.sources or None for row in self.rows]
        candidates = {row.joint: list(row.candidates) for row in self.open_rows if row.candidates}
        more: dict[str, Any] = {"candidates": candidates} if candidates else {}
        return map_text(self.target, sources, note=note, unmapped=self.unmapped, **more)
