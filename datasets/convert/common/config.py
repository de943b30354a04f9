"""The options that every converter has."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, get_args

from pydantic import Field, field_validator
from pydantic.fields import FieldInfo

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import MotionType
from motionloom.datasets.convert.common.facts import parse_where
from motionloom.datasets.motion.layout import LAYOUTS, MotionLayout

END_TOLERANCE = 0.5
"""Seconds that a caption may reach past its clip: sources round their times."""


class ConvertConfig(Config):
    """Options that every converter has. The docstrings of the fields are the command line's help."""

    layouts: ClassVar[tuple[str, ...]] = LAYOUTS
    """Layouts that can be made from the source."""
    everyday: ClassVar[tuple[str, ...]] = ()
    """Fields that the command line has an option for; all others are settings (`--set KEY=VALUE`)."""

    source: Path
    """Folder of the source, as its authors publish it."""
    name: str
    """Name of the data set; part of the shards' file names."""
    layout: str
    """Feature layout of the shards (docs/data.md lists them)."""
    fps: float = Field(gt=0, le=240)
    """Frame rate of the shards; clips are resampled by time."""
    licence: str | None = None
    """Overrides the licence the converter states for the source."""
    min_seconds: float = Field(default=1.0, ge=0)
    """Shorter clips are left out."""
    max_seconds: float | None = Field(default=None, gt=0)
    """Longer clips are left out."""
    limit: int | None = Field(default=None, ge=1)
    """Convert only this many clips, chosen by a hash of the id so that they stay spread over the source."""
    where: str = Field(default="", json_schema_extra={"runtime": True})
    """Convert only clips of which this holds: `category=dance and seconds<30` (=, !=, <, <=, >, >=; `and`).
    A wrong name is answered with the names that are known of the source's clips."""
    motion_type: MotionType = "float32"
    """`float16` halves the shards; positions then keep about a millimetre."""
    look: int = Field(default=5, ge=0, json_schema_extra={"runtime": True})
    """Clips of every subset to read and measure first; 0 for none. A source that then shows no people
    standing on a floor is refused."""

    most_rejected: float = Field(default=0.5, ge=0, le=1, json_schema_extra={"runtime": True})
    """Share of the clips that may turn out unreadable or unfit; a conversion that loses more fails, although
    what is left of it is written."""

    @field_validator("*")
    @classmethod
    def _home(cls, value: object) -> object:
        """Paths with `~` for the home folder, which no shell expands behind `--set KEY=`."""
        return value.expanduser() if isinstance(value, Path) else value

    @field_validator("where")
    @classmethod
    def _conditions(cls, text: str) -> str:
        parse_where(text)
        return text

    def motion_layout(self) -> MotionLayout:
        if self.layout not in self.layouts:
            raise UserError(
                f"layout {self.layout} cannot be made from this source; use {', '.join(self.layouts)}"
            )
        return MotionLayout.named(self.layout, fps=self.fps)

    def options(self) -> dict[str, object]:
        """Return the fields that the output depends on: no local path, whose content counts instead."""
        fields = type(self).model_fields
        kept = {name for name, field in fields.items() if not _is_local(field)}
        return {key: value for key, value in self.dump().items() if key in kept}

    def length_problem(self, seconds: float) -> str:
        """Return the reason to leave out a clip of this length; empty when it may come."""
        if seconds < self.min_seconds:
            return f"{seconds:.2f} s, shorter than {self.min_seconds:g} s"
        if self.max_seconds is not None and seconds > self.max_seconds:
            return f"{seconds:.2f} s, longer than {self.max_seconds:g} s"
        return ""


def _is_local(field: FieldInfo) -> bool:
    extra = field.json_schema_extra
    runtime = isinstance(extra, dict) and bool(extra.get("runtime"))
    return runtime or field.annotation is Path or Path in get_args(field.annotation)
