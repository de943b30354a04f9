"""A clip of a plan, what is asked of it by name, and numbers of many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from motionloom.datasets.base.records import Split
from motionloom.datasets.convert.common.facts import Facts


class PlannedClip(Protocol):
    """A clip of a plan: what a converter hands to its function from clip to sample. One whose label is not
    the name of its motion file in the source says that as `file`.
    """

    @property
    def id(self) -> str:
        """Its name in the data set."""
        ...

    @property
    def split(self) -> Split: ...

    def label(self) -> str:
        """Name in reports. A changed file must change it: name and size will do."""
        ...


C = TypeVar("C", bound=PlannedClip)


def facts_of(clip: PlannedClip) -> Facts:
    """Facts of a clip by name, for `where`: id, split, and the clip's own `facts`."""
    facts: Facts = getattr(clip, "facts", {})
    return {"id": clip.id, "split": clip.split, **facts}


def file_of(clip: PlannedClip) -> str:
    """The name of a clip's motion file in the source."""
    return str(getattr(clip, "file", clip.label()))


def words_of(clip: PlannedClip) -> frozenset[str]:
    """The sentences of a clip."""
    return frozenset(text.text for text in getattr(clip, "texts", ()))


@dataclass
class Words:
    """Clips with and without captions, where captions are wanted; by their labels."""

    captioned: int = 0
    """Clips that have them, and nothing against them."""
    uncaptioned: list[str] = field(default_factory=list)
    bare: list[str] = field(default_factory=list)
    """Clips that lack nothing but captions."""
    summary: str = ""
    """Number of clips with captions, and those without, where the user brought captions."""


@dataclass
class Totals:
    """Numbers of a finished plan."""

    found: int = 0
    """Motion files in the source."""
    clips: int = 0
    """Clips found, taken or not, and their hours."""
    hours: float = 0.0
    frames: dict[Split, int] = field(default_factory=dict)
    """Expected frames a split, at the target frame rate."""
    measured: dict[str, int] = field(default_factory=dict)
    """The frames of clips that were converted to see what becomes of them, by their ids."""
    licences: dict[str, int] = field(default_factory=dict)
    """Clips to convert under each licence."""
    bytes_needed: int | None = None
    """Disk that the shards will take; None when unknown."""
    count: Callable[[], None] = lambda: None
    """Counts frames and licences again."""
