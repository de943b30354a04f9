"""The count audit: what a set's paper or card says there is, and what of it was found.

A set states its numbers once (`Published`). Their names say how they are counted: `clips` and `hours` of all
clips found; a condition of `where.py` (`subset=aist`), the clips that meet it; the name of a fact
(`actor_uid`), its different values.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

from motionloom.datasets.convert.common.where import Facts, parse_where
from motionloom.datasets.schema import AuditRow


@dataclass(frozen=True)
class Published:
    """Numbers that the makers of a set state."""

    by: str
    """Where, such as `card, 2026-03`."""
    counts: Mapping[str, float]


@dataclass
class Audit:
    """Counts the clips of a plan beside what is published. Without published numbers it stays empty."""

    published: Published | None = None
    _found: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    _taken: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    _values: set[tuple[str, bool, str]] = field(default_factory=set)
    """Different values of facts: name, whether of clips that are taken, value."""

    def add(self, facts: Facts, *, taken: bool) -> None:
        """One clip that was found; `facts` has its length as `seconds`."""
        for name in self.published.counts if self.published else ():
            self._found[name] += self._worth(name, facts, False)
            self._taken[name] += self._worth(name, facts, True) if taken else 0

    def _worth(self, name: str, facts: Facts, taken: bool) -> float:
        if name == "clips":
            return 1.0
        if name == "hours":
            seconds = facts.get("seconds", 0.0)
            return seconds / 3600 if isinstance(seconds, int | float) else 0.0
        if not name.isidentifier():
            return float(all(condition.holds(facts) for condition in parse_where(name)))
        value = (name, taken, str(facts.get(name, "")))
        new = name in facts and value not in self._values
        self._values.add(value)
        return float(new)

    def rows(self, clips: int, why: str) -> list[AuditRow]:
        """The table; `clips` is how many are left in the plan, and `why` says why others are not."""
        if self.published is None:
            return []
        self._taken["clips"] = clips
        return [
            AuditRow(
                what=name,
                stated=count,
                by=self.published.by,
                found=round(self._found[name], 3),
                taken=round(self._taken[name], 3),
                why=why if name == "clips" else "",
            )
            for name, count in self.published.counts.items()
        ]
