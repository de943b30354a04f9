"""A source: `NAME.npy` with joints [T, 22, 3] in metres, Y up, and `NAME.txt` with what the person does."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from motionloom import register
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.shards.sample import Sample


class ArraysConfig(ConvertConfig):
    """Options on the command line and keys of a recipe's `kind: arrays`."""

    name: str = "arrays"
    layout: str = "body133"
    fps: float = 20.0
    size: float = 1.0
    """Scale of the figure."""


class ArraysClip(NamedTuple):
    """One file of the source."""

    id: str
    split: Split
    path: Path

    def label(self) -> str:
        """Its name in reports."""
        return self.path.name


@register
class Arrays(Converter[ArraysConfig, ArraysClip]):
    """Joints in NumPy files; those that begin with "test" are the test split."""

    name, title, summary = "arrays", "NumPy files", "Joints in NumPy files to shards."
    example = "takes shards"
    config_class = ArraysConfig

    def plan(self, settings: PlanSettings) -> ConversionPlan[ArraysClip]:
        """Every file, without reading it."""
        draft = ConversionPlan[ArraysClip](self.config)
        for path in sorted(self.config.source.glob("*.npy")):
            draft.add(ArraysClip(path.stem, "test" if path.stem.startswith("test") else "train", path))
        return draft.finish(found=len(draft.items), frames=self._frames, licence=lambda clip: "CC0")

    def _frames(self, clip: ArraysClip) -> int:
        return len(np.load(clip.path, mmap_mode="r"))

    def depends_on(self, clip: ArraysClip) -> list[object]:
        """A clip whose file or text changes is made again."""
        return [clip.id, clip.path.stat().st_size, clip.path.with_suffix(".txt").read_text()]

    def joints(self, clip: ArraysClip) -> SourceJoints:
        """Also for the look at the source before it is converted."""
        return SourceJoints(np.load(clip.path) * self.config.size, self.config.fps)

    def convert(self, clip: ArraysClip) -> Sample:
        """The columns of the layout, and the caption."""
        motion = features_of(self.joints(clip).joints, self.config.fps, self.layout)
        caption = Caption(text=clip.path.with_suffix(".txt").read_text().strip())
        return Sample(self.meta(clip, motion, licence="CC0"), motion, texts=[caption])
