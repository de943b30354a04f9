"""What a data set is and how it is written: the two records that `write_dataset` takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import SCHEMA_VERSION, Dropped, UserError
from motionloom.datasets.shards.sample import MotionType


@dataclass(frozen=True)
class Part:
    """One machine's share of a conversion: every `count`-th task from `index` (from 0) on.

    `step` is `shards`, or `features` for the sources that need that step first.
    """

    index: int
    count: int
    step: Literal["features", "shards"] = "shards"

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            raise UserError(
                f"part {self.index} of {self.count}: parts are numbered from 0 to {self.count - 1}"
            )

    def has(self, position: int) -> bool:
        """Whether the task at `position` of all tasks is this part's."""
        return position % self.count == self.index


@dataclass(frozen=True)
class DatasetFacts:
    """What a data set is: everything of its manifest that is known before the first clip is converted."""

    name: str
    layout: MotionLayout
    licence: str
    converter: str
    converter_version: int
    options: dict[str, Any]
    """What the output depends on, as plain JSON; never a local path."""
    motion_type: MotionType = "float32"
    """How `motion.npy` is stored."""
    licences: dict[str, int] = field(default_factory=dict)
    """Clips under each licence, for sources that mix several."""
    audio: dict[str, Any] | None = None
    """Settings the audio features are made with."""
    dropped: Sequence[Dropped] = ()
    """Clips that the plan has left out already."""
    notes: Sequence[str] = ()

    def made_from(self) -> dict[str, Any]:
        """What the bytes of every shard depend on, beside its items."""
        layout = self.layout
        return {
            "schema_version": SCHEMA_VERSION,
            "layout": [layout.name, layout.family, layout.fps, layout.skeleton_name],
            "converter": [self.converter, self.converter_version],
            "options": self.options,
            "motion_type": self.motion_type,
        }


@dataclass(frozen=True)
class WriteOptions:
    """How a data set is written. Only `seed` and `clips_per_shard` show in the shards."""

    workers: int = 1
    """Processes."""
    clips_per_shard: int = 256
    seed: int = 0
    """Of the order in which clips go to shards."""
    strict: bool = False
    """Stop at the first item that fails, instead of leaving it out."""
    progress: bool = True
    part: Part | None = None
    """Make this part only, and no manifest. Parts may run at once; a run without one excludes all others."""

    @property
    def features_only(self) -> bool:
        """Whether this is a part that writes no shards."""
        return self.part is not None and self.part.step == "features"

    def has(self, position: int) -> bool:
        """Whether the task at `position` is to be made now."""
        return self.part is None or self.part.has(position)
