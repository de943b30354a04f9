"""Facts known of clips: `--set where="category=dance and seconds<30"` chooses by them, an audit counts them.

Conditions are `NAME OPERATOR VALUE` with =, !=, <, <=, > or >=, joined by `and`; a value that holds `and` or
an operator stands in quotes. Nothing is evaluated. Words are compared without regard to case, = holds for one
of several values, and a clip of which the name is not known meets no condition.

A set states its published numbers once (`Published`). Their names say how they are counted: `clips` and
`hours` of all clips found; a condition (`subset=aist`), the clips that meet it; the name of a fact
(`actor_uid`), its different values.
"""

from __future__ import annotations

import operator
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

from motionloom.datasets.schema import AuditRow, UserError

Fact = str | float | tuple[str, ...]
"""Value of a fact of a clip: words, a number, or several words."""
Facts = Mapping[str, Fact]

_ORDER: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_CONDITION = re.compile(
    r"""\s*(?P<name>[A-Za-z_][\w.]*)\s*(?P<sign><=|>=|!=|=|<|>)\s*"""
    r"""(?P<value>"[^"]*"|'[^']*'|(?:(?!\sand(?:\s|$))[^<>=!"'])+)\s*(?P<rest>\band(?:\s|$)|$)""",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Condition:
    """One comparison."""

    name: str
    sign: str
    value: str

    def holds(self, facts: Facts) -> bool:
        known = facts.get(self.name)
        if known is None:
            return False
        if self.sign in _ORDER:
            left, right = _number(known), _number(self.value)
            return left is not None and right is not None and _ORDER[self.sign](left, right)
        values = known if isinstance(known, tuple) else (known,)
        return any(_same(one, self.value) for one in values) == (self.sign == "=")


@lru_cache(maxsize=64)
def parse_where(text: str) -> tuple[Condition, ...]:
    """The conditions of an expression; `UserError` that quotes the part that is none."""
    found: list[Condition] = []
    at = 0
    while at < len(text.rstrip()) or (text.strip() and not found):
        match = _CONDITION.match(text, at)
        if match is None:
            raise UserError(
                f"where: '{text[at:].strip()[:60]}' is no condition; write NAME=VALUE, !=, <, <=, > or >=, "
                f'joined by `and`, such as "category=dance and seconds<30"'
            )
        found.append(Condition(match["name"], match["sign"], match["value"].strip().strip("\"'")))
        at = match.end()
        if match["rest"].strip() and at >= len(text.rstrip()):
            raise UserError(f"where: nothing follows the last `and` of '{text.strip()[:60]}'")
    return tuple(found)


def require_known(text: str, names: Iterable[str]) -> None:
    """`UserError` that lists the names there are, when the expression asks for one that no clip has."""
    known = sorted(names)
    for condition in parse_where(text):
        if condition.name not in known:
            raise UserError(f"where: no clip has '{condition.name}'; known of clips: {', '.join(known)}")


def _number(value: Fact) -> float | None:
    try:
        return float(value) if isinstance(value, str | int | float) else None
    except ValueError:
        return None


def _same(known: Fact, value: str) -> bool:
    left, right = _number(known), _number(value)
    if left is not None and right is not None:
        return left == right
    return str(known).strip().lower() == value.lower()


@dataclass(frozen=True)
class Published:
    """Numbers that the makers of a set state."""

    by: str
    """Document that states them, such as `card, 2026-03`."""
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
