"""What a package adds to models, beside generating and captioning: `MotionModel.ability(name)`.

# my_package/count.py
register(Ability("count", count_steps, "counts no steps"))     # model.ability("count")(clip)

# my_package/table.py, which the entry point names
declare("ability", {"count": "my_package.count"})
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import Table, discover
from motionloom.pipeline.contract.generation import MotionGenerator


@dataclass(frozen=True)
class Ability:
    """One thing that some models can do."""

    name: str
    """Generators that can have it in their `Capabilities.more`."""
    function: Callable[..., Any]
    """Called with the `MotionModel` before the caller's own arguments."""
    without: str
    """Why others cannot, and what to do: "edits none; take an in-betweener"."""


ABILITIES: Table[Ability] = Table(Ability, "ability")


def ability_of(generator: MotionGenerator, name: str) -> Callable[..., Any]:
    """The function of an ability that a generator has; `UserError` where it has not, or nothing installed
    adds it.
    """
    discover()
    if name not in ABILITIES:
        raise UserError(f"{name}: nothing that is installed here can do this; install motionloom whole")
    ability = ABILITIES[name]
    if name not in generator.capabilities.more:
        raise UserError(f"this model ({generator.method}) {ability.without}")
    return ability.function
