"""Settings of writing and reading a data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.records import SCHEMA_VERSION, Dropped, MotionType
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.cache import CacheConfig

SOURCE_CHECKSUM = "source_sha256"
"""The option that stands for the source's content: a finished data set follows its source, clip by clip."""


@dataclass(frozen=True)
class Part:
    """One machine's share of a conversion: every `count`-th shard from that of its `number` (from 1) on."""

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise UserError(f"part {self}: parts are numbered from 1 to {self.count}")

    @classmethod
    def parse(cls, text: str) -> Part:
        """The part of `3/8`."""
        number, _, count = text.partition("/")
        where = f"part '{text}': write it as K/N, such as 3/8 for the third of eight parts"
        return cls(whole(number, where), whole(count, where))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def has(self, position: int) -> bool:
        return position % self.count == self.number - 1


@dataclass(frozen=True)
class DatasetFacts:
    """Facts of a data set's manifest that are known before the first clip is converted."""

    name: str
    layout: MotionLayout
    licence: str
    converter: str
    converter_version: int
    options: dict[str, object]
    """Everything that the output depends on, as plain JSON; never a local path."""
    motion_type: MotionType = "float32"
    """Number type of `motion.npy`."""
    licences: dict[str, int] = field(default_factory=dict)
    """Clips under each licence, for sources that mix several."""
    credits: Sequence[str] = ()
    """Attributions that these licences require."""
    audio: dict[str, object] | None = None
    """Settings of the audio features."""
    dropped: Sequence[Dropped] = ()
    """Clips that the plan has left out already."""
    not_ours: Sequence[Dropped] = ()
    """What else of the source and its lists became no clip, for `left-out.txt` alone."""
    lost: Sequence[Dropped] = ()
    """Clips among `dropped` that were meant to become samples."""
    most_lost: float = 1.0
    """Largest share of the clips that may be lost; beyond it the conversion fails."""
    notes: Sequence[str] = ()

    def made_from(self) -> dict[str, object]:
        """Return everything that the bytes of all clips depend on, apart from their sources."""
        layout = self.layout
        options = {key: value for key, value in self.options.items() if key != SOURCE_CHECKSUM}
        return {
            "schema_version": SCHEMA_VERSION,
            "layout": [layout.name, layout.family, layout.fps, layout.skeleton_name],
            "converter": [self.converter, self.converter_version],
            "options": options,
            "motion_type": self.motion_type,
        }


@dataclass(frozen=True)
class WriteOptions:
    """Settings of writing a data set. Only `seed` and `clips_per_shard` show in the shards."""

    workers: int = 1
    """Processes."""
    clips_per_shard: int = 256
    seed: int = 0
    """Seed of the order in which clips go to shards."""
    strict: bool = False
    """Stop at the first item that fails, instead of leaving it out."""
    progress: bool = True
    part: Part | None = None
    """Make this part only, and no manifest. Parts may run at once; a run without one excludes all others."""


class Reading(Config):
    """Reader and order of one data set."""

    order: Literal["global", "streamed"] = "global"
    """`global` shuffles all clips each epoch; `streamed` shuffles shards, and mixes the clips of
    `shards_per_group` at a time, so that a small cache or a slow disk serves a large data set."""
    shards_per_group: int = Field(8, ge=1)
    """Shards whose clips are mixed in the streamed order. Where it is a multiple of the nodes, and of
    `accumulate` times these, each node reads its share of the shards alone."""
    cache: CacheConfig = CacheConfig()
