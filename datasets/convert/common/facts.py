"""Facts known of clips: `--set where="category=dance and seconds<30"` chooses by them.

Conditions are `NAME OPERATOR VALUE` with =, !=, <, <=, > or >=, joined by `and`; a value that holds `and` or
an operator stands in quotes. Nothing is evaluated. Words are compared without regard to case, = holds for one
of several values, and a clip of which the name is not known meets no condition.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

from motionloom.datasets.schema import UserError

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
