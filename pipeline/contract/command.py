"""Commands that a package adds to the command line, beside `run`, `generate` and the others.

# my_package/commands.py
register(Command("mine", mine))              # motionloom mine …
register(Command("data mine", mine_data))    # motionloom data mine …

# my_package/table.py, which the entry point names: the command's module is imported where it is asked for
declare("command", {"mine": "my_package.commands", "data mine": "my_package.commands"})
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from motionloom.datasets.base.register import Table


@dataclass(frozen=True)
class Command:
    """One command of the command line."""

    name: str
    """As it is typed, the group before it: "edit", "data clean". Groups are motionloom's own."""
    function: Callable[..., object]
    """Does it: typer makes arguments and options of its signature, and the help of its docstring. Annotations
    of `pipeline/cli/options.py` may be used. Raises `UserError` for a user's mistake."""


COMMANDS: Table[Command] = Table(Command, "command")
