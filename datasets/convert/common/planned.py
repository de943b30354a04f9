"""A clip of a plan, and what is asked of it by name."""

from __future__ import annotations

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
