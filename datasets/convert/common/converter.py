"""`Converter`: what a source must answer; the same few questions for every kind of source.

Ours are a folder with a `convert.py` each, another package's class is given to `register`. Command line,
recipes and clusters find both by name (`convert/registry.py`).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.licences import credits_of
from motionloom.datasets.base.records import ClipMeta, Fault
from motionloom.datasets.base.register import Table
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.planned import C, PlannedClip, facts_of, words_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import Sample

Cfg = TypeVar("Cfg", bound=ConvertConfig)


@dataclass(frozen=True)
class PlanSettings:
    """Workers and files for planning; no effect on the result."""

    workers: int = 1
    progress: bool = False
    maps: Path | None = None
    """Folder for the joint maps that are guessed."""


class Converter(ABC, Generic[Cfg, C]):
    """One kind of source, opened with its options. Picklable: workers convert with a copy."""

    name: ClassVar[str]
    """On the command line, as the kind of a stage, and in manifests."""
    title: ClassVar[str]
    """The source's own name."""
    summary: ClassVar[str]
    """One line for the help."""
    example: ClassVar[str]
    """Words behind `motionloom data convert NAME` in the example of the help."""
    config_class: ClassVar[type[ConvertConfig]]
    """Options of the command line and of a recipe's stage; the docstrings of its fields are their help."""
    published: ClassVar[str] = ""
    """Numbers that the makers of a set state, and where; a note of the plan says what is found of them."""
    credit: ClassVar[str] = ""
    """The sentence that names the makers of a set, where its licence asks for one."""
    beside: ClassVar[tuple[str, ...]] = ()
    """Endings of files without motion that motion files are read with."""
    version: ClassVar[int] = 1
    """Raised when the same source gives other samples: finished shards are then made again."""

    def __init__(self, config: Cfg) -> None:
        self.config = config

    @cached_property
    def layout(self) -> MotionLayout:
        """The layout of the shards, at their frame rate."""
        return self.config.motion_layout()

    @abstractmethod
    def plan(self, settings: PlanSettings) -> ConversionPlan[C]:
        """Look at the whole source and decide what becomes of every file, without converting anything.

        `ConversionPlan.add` or `skip` each, then `finish`. `UserError` for a source of another kind.
        """

    @abstractmethod
    def convert(self, clip: C) -> Sample | list[Sample]:
        """The sample of one clip, or several: motion [T, D] of `layout`, `meta`, captions, sound.

        `UserError` or `DropClip` for what cannot be a person's motion: the clip is left out, with the reason.
        """

    @abstractmethod
    def joints(self, clip: C) -> SourceJoints:
        """The joints of one clip as they are read, metres [T, N, 3] at the source's frame rate, for the look
        at a source before it is converted. `UserError` for a file that cannot be read.
        """

    @abstractmethod
    def depends_on(self, clip: C) -> list[object]:
        """Return all that the sample of a clip is made from, as plain JSON: its id, sizes or checksums of its
        files, captions. When it changes, the clip is made again.
        """

    def licence(self, plan: ConversionPlan[C]) -> str:
        """The licence of the whole data set."""
        return self.config.licence or next(iter(plan.totals.licences), "")

    def credits(self, plan: ConversionPlan[C]) -> list[str]:
        """Return the sentences that the licences of the planned clips ask for."""
        return credits_of(plan.totals.licences, self.config.name, [self.credit] if self.credit else [])

    def copies(self, plan: ConversionPlan[C]) -> list[str]:
        """Return notes on files of one content that are taken for several clips or songs."""
        return []

    def options(self) -> dict[str, object]:
        """Return all that samples depend on beside the source: options, and facts of the files they name."""
        return self.config.options()

    def audio(self) -> dict[str, object] | None:
        """Settings of the audio features in the samples, as plain JSON; None without any."""
        return None

    def subset(self, clip: C) -> str:
        """Return the part of the source that a clip is in: some clips of each are looked at."""
        return str(facts_of(clip).get("subset", ""))

    def stratum(self, clip: C) -> str:
        """Return the kind of file that a clip is read from: a plan tries some of each."""
        return f"{self.subset(clip)} {facts_of(clip).get('fps', '')}"

    def meta(
        self,
        clip: C,
        motion: NDArray[np.float32],
        *,
        seen: SourceJoints | None = None,
        hands: bool = False,
        face: bool = False,
        source: str | None = None,
        licence: str | None = None,
        mirror_of: str | None = None,
    ) -> ClipMeta:
        """Return a sample's facts: `motion` [T, D], the joints that it is `seen` by, which are judged, parts
        recorded, and the id of the clip it mirrors.
        """
        about = self.layout.clip_meta(
            clip.id,
            source=source or clip.label(),
            split=clip.split,
            frames=len(motion),
            licence=licence or self.config.licence or "",
            has_hands=hands,
            has_face=face,
            mirror_of=mirror_of,
        )
        if seen is None:
            return about
        return about.model_copy(update={"faults": (*seen.faults(self.layout.fps), *_names(clip))})


def _names(clip: PlannedClip) -> Iterator[Fault]:
    """Captions of several words that are the file's name."""
    name = " ".join(re.findall(r"[^\W_]+", clip.id.lower()))
    for text in sorted(words_of(clip)):
        words = " ".join(re.findall(r"[^\W_]+", text.lower()))
        if " " in words and words in name:
            yield Fault(
                kind="caption is a name", text=f"'{text}' is the file's name, no sentence", weight=1.0
            )


AnyConverter = Converter[Any, Any]

CONVERTERS: Table[type[AnyConverter]] = Table(Converter, "converter", classes=True)
"""Converters that other packages have registered; `convert/registry.py` finds ours."""
