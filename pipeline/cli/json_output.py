"""`--json`: what a command found, as JSON alone on standard output; all else goes to standard error."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

AsJson = Annotated[
    bool, typer.Option("--json", help="Print JSON for programs; all else goes to standard error.")
]


def print_json(result: Any) -> None:
    """Print a result: plain data, a config, a dataclass, or any of these within each other."""
    typer.echo(json.dumps(plain(result), indent=1, ensure_ascii=False, allow_nan=False))


def plain(value: Any) -> Any:
    """`value` as JSON knows it. Paths become text, sets and tuples lists; JSON has no NaN: null."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="json"))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, Set):
        return sorted(plain(entry) for entry in value)
    if isinstance(value, Sequence):
        return [plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")
