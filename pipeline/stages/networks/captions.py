"""Base of stages that train on whole clips with their captions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.pipeline.contract.stage import Inputs
from motionloom.pipeline.stages.networks.clips import clip_batches, motion_example
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage

if TYPE_CHECKING:
    from motionloom.datasets.loading.condition_batches import Captioned
    from motionloom.pipeline.store.data import Data
    from motionloom.pipeline.store.text import TextSource


class CaptionStageConfig(TrainedStageConfig):
    """Clips of these lengths, and the columns of them."""

    max_frames: int = Field(196, ge=8)
    """Longer clips are cropped at random."""
    min_frames: int = Field(16, ge=1)
    """Shorter clips are left out."""
    part: Part = "bodyhand"
    """Columns of the layout; `face` takes the face captions."""


class CaptionInputs(Inputs):
    """Captioned clips, their statistics and the text encoder."""

    data: Data
    stats: FeatureStats
    text: TextSource


C = TypeVar("C", bound=CaptionStageConfig)
I = TypeVar("I", bound=CaptionInputs)  # noqa: E741
N = TypeVar("N", bound=nn.Module)


class CaptionStage(TrainedStage[C, I, N]):
    """A stage that trains on one part of whole clips and what is said of it."""

    exports: tuple[str, ...] = ("stats", "text")

    def batches(self, config: C, net: N, inputs: I, seed: int, log: Log) -> Batches:
        captioned: Captioned = "face" if config.part == "face" else "body"
        clips = clips_of(config, inputs.data.layout, captioned)
        return clip_batches(inputs.data, inputs.stats, {"text": inputs.text.cache}, seed, clips=clips)

    def example(self, config: C, net: N, inputs: I, batch: int) -> Example:
        frames = config.max_frames
        width = inputs.text.dim
        dim = len(part_columns(inputs.data.layout, config.part))
        conditions = {"text": MODALITIES["text"].example(batch, frames, width)}
        similarity = torch.empty(batch, width)
        return Example(motion_example(batch, frames, dim, conditions=conditions, similarity=similarity))


def clips_of(config: CaptionStageConfig, layout: MotionLayout, captioned: Captioned | None) -> dict[str, Any]:
    """Return lengths, columns and kind of captions, as `clip_batches` takes them."""
    return {
        "max_frames": config.max_frames,
        "min_frames": config.min_frames,
        "columns": part_columns(layout, config.part),
        "captioned": captioned,
    }


def part_columns(layout: MotionLayout, part: Part) -> NDArray[np.int64]:
    """Columns of one part of a layout, which must have it."""
    if not layout.has_part(part):
        raise UserError(f"layout {layout.name} has no {part} columns; choose another part or data set")
    return layout.part(part)


def joint_loss_settings(
    layout: MotionLayout, part: Part, stats: FeatureStats | None, loss: Config
) -> dict[str, object]:
    """Return what a `JointsModule` takes of one part's columns; a dry run has no statistics."""
    columns = part_columns(layout, part)
    known = stats or FeatureStats.unit(layout)
    return {"layout": layout, "mean": known.mean[columns], "std": known.std[columns], "loss": loss}


def part_of(facts: ModelFacts) -> Part:
    """The part that a stage noted in its facts, `extra.part`."""
    part = facts.fact("part", str)
    if part not in get_args(Part):
        raise UserError(
            f"{facts.where}: key 'extra.part' = {part!r} is no part; run or export the stage again"
        )
    return cast(Part, part)
