"""Facts known of clips: `--set where="category=dance and seconds<30"` chooses by them.

Conditions are `NAME OPERATOR VALUE` with =, !=, <, <=, > or >=, joined by `and`; a value that holds an
operator stands in quotes. Nothing is evaluated. Words are compared without regard to case, = holds for one of
several values, and a clip of which the name is not known meets no condition.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

from motionloom.datasets.base.errors import UserError

Fact = str | float | tuple[str, ...]
"""Value of a fact of a clip: words, a number, or several words."""
Facts = Mapping[str, Fact]

_ORDER: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_AND = re.compile(r"(?<!\s)\s+and(?:\s+(?=[A-Za-z_][\w.]*\s*[<>=!])|\s*$)", re.IGNORECASE)
"""The word between two conditions: `and` within a value is followed by no name with an operator."""
_CONDITION = re.compile(r"""([A-Za-z_][\w.]*)\s*(<=|>=|!=|=|<|>)\s*("[^"]*"|'[^']*'|[^<>=!"']+)""")


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
            left = _number(known)
            right = _number(self.value)
            return left is not None and right is not None and _ORDER[self.sign](left, right)
        values = known if isinstance(known, tuple) else (known,)
        return any(_same(one, self.value) for one in values) == (self.sign == "=")


@lru_cache(maxsize=64)
def parse_where(text: str) -> tuple[Condition, ...]:
    """The conditions of an expression; `UserError` that quotes the part that is none."""
    found = []
    for part in _AND.split(text.strip()) if text.strip() else ():
        match = _CONDITION.fullmatch(part.strip())
        if match is None:
            raise UserError(
                f"where: '{part.strip()[:60]}' is no condition; write NAME=VALUE, !=, <, <=, > or >=, "
                f'joined by `and`, such as "category=dance and seconds<30"'
            )
        name, sign, value = match.groups()
        found.append(Condition(name, sign, value.strip().strip("\"'")))
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
    left = _number(known)
    right = _number(value)
    if left is not None and right is not None:
        return left == right
    return str(known).strip().lower() == value.lower()
