"""`Config`: the base of every config and record, so that a misspelt key or a wrong type is refused in one
sentence that names the file, the key and the nearest valid name.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.json_doors import parse_json, read_plain

FrameRate = Annotated[float, Field(ge=0.1, le=1000)]
"""Frames a second of a motion."""


class Config(BaseModel):
    """Base of every config class and record: unknown keys, wrong types and numbers that are not finite are
    refused, values are frozen."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, defer_build=True, allow_inf_nan=False
    )

    @classmethod
    def parse(cls, data: Any, where: str) -> Self:
        """Validate `data`; a `UserError` names `where` (a file or a dotted key) and the nearest name."""
        try:
            made = cls.model_validate(data)
        except ValidationError as error:
            raise UserError(explain(error.errors(), cls, where)) from None
        require_local(made)
        return made

    @classmethod
    def load_json(cls, path: Path) -> Self:
        """Read one record from a JSON file."""
        try:
            raw = read_plain(path)
        except FileNotFoundError:
            raise UserError(f"{path}: no such file") from None
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
        return cls.parse(parse_json(raw, str(path)), str(path))

    def dump(self) -> dict[str, Any]:
        """Plain JSON types, every default written out."""
        return self.model_dump(mode="json")


_SHOWN = 10
"""Problems of one record that are told; a file may have thousands."""


def explain(problems: Sequence[Mapping[str, Any]], model: type[BaseModel], where: str) -> str:
    """One line per problem, with the nearest valid key for each unknown one; ten, and how many more."""
    lines = []
    for item in problems[:_SHOWN]:
        loc = [str(part) for part in item["loc"]]
        key = ".".join(loc) or "(top level)"
        if item["type"] == "extra_forbidden":
            names = field_names(model, loc[:-1])
            lines.append(f"{where}: unknown key '{key}'{nearest(loc[-1], sorted(names), what='keys')}")
        elif item["type"] == "missing":
            lines.append(f"{where}: key '{key}' is required")
        else:
            message = item["msg"].removeprefix("Value error, ")
            shown = f"key '{key}' = {item.get('input')!r:.60}: " if loc else ""
            lines.append(f"{where}: {shown}{message}")
    if (more := len(problems) - _SHOWN) > 0:
        lines.append(f"{where}: and {more:,} more")
    return "\n".join(lines)


def field_names(model: type[BaseModel], path: list[str]) -> list[str]:
    """Valid keys of the model at `path`, also of one in a list; unions of several are not followed."""
    current: Any = model
    for part in path:
        fields = getattr(current, "model_fields", {})
        if part in fields:
            current = _model_in(fields[part].annotation)
        elif not part.isdecimal():  # a place in a list of what is current already
            return list(fields)
    return list(getattr(current, "model_fields", {}))


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The one model that a field's type is or holds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = {model for inner in get_args(annotation) if (model := _model_in(inner)) is not None}
    return found.pop() if len(found) == 1 else None


def require_local(place: object) -> None:
    """Refuse a URL where a path is wanted: as a path, `s3://bucket/x` is a folder named `s3:`.

    `place` may be anything: of lists and configs all paths are looked at, of what else there is nothing.
    """
    if isinstance(place, Path):
        if found := re.match(r"([A-Za-z][A-Za-z0-9+.-]+):/", str(place)):
            raise UserError(
                f"{found[1]}://{str(place)[found.end() :].lstrip('/')}: no URL is read or written here, only "
                f"this machine's files; `motionloom data copy` carries data sets there and back, and stages "
                f"of kind `shards` read them there"
            )
    elif isinstance(place, list | tuple):
        for one in place:
            require_local(one)
    elif isinstance(place, Config):
        for name in _with_paths(type(place)):
            require_local(getattr(place, name))


@cache
def _with_paths(model: type[Config]) -> tuple[str, ...]:
    """Fields that may hold a path: most records have none, and a data set has millions of records."""
    return tuple(name for name, field in model.model_fields.items() if _holds_path(field.annotation))


def _holds_path(annotation: Any) -> bool:
    """Whether a field's type is, or is made of, one that may be a path."""
    if inner := get_args(annotation):
        return any(map(_holds_path, inner))
    plain = (str, int, float, bool, type(None))
    return annotation is Any or (isinstance(annotation, type) and annotation not in plain)
