"""The commands of the program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from typer.main import get_command

from motionloom.datasets.base.register import discover
from motionloom.pipeline.cli.main import app


def commands(group: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command: its words, and the object that reads its arguments."""
    if group is None:
        discover()
        group = get_command(app)
    if not hasattr(group, "list_commands"):
        yield path, group
        return
    for name in group.list_commands(None):
        yield from commands(group.get_command(None, name), (*path, name))
