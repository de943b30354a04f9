"""Statistics of a modality's features, by which networks read it normalised (UDE section 4.1, of music)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.statistics import frame_statistics
from motionloom.datasets.modalities.modality import FrameStats, Modality
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.pipeline.contract.stage import (
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.files import copy_files


class FeaturesConfig(StageConfig):
    """The features are those of the shards."""

    width: int | None = Field(None, ge=1)
    """How many the shards hold, where a modality has several kinds: of music 438, or those of rhythm.
    None = the modality's usual ones."""
    raw: bool = False
    """Networks read the features as they are: of a release that did (`published`)."""
    rate: float | None = Field(None, ge=5, le=240)
    """Rows a second that the shards' features were analysed at (`audio_fps` of the converter), where that was
    not each frame of the motion: a song that somebody gives is analysed so too."""


@dataclass(frozen=True)
class FeaturesPreview:
    """Return a preview of the statistics before the stage has run."""

    dim: int


class FeaturesStage(StageKind[FeaturesConfig]):
    """Mean and deviation of every feature of one modality over the training split."""

    config = FeaturesConfig
    takes = ("data",)

    def __init__(self, modality: Modality) -> None:
        assert modality.width is not None
        self.name = modality.name
        self.modality = modality
        self.width = modality.width
        self.summary = f"statistics of {modality.name} features"
        self.file = f"{modality.name}.safetensors"

    def modules(self, config: FeaturesConfig) -> Iterable[str]:
        return [*super().modules(config), type(self.modality).__module__]

    def run(self, context: StageContext) -> None:
        stats = frame_statistics(context.given["data"].split("train"), self.modality)
        wanted = context.config.width or self.width
        if stats.dim != wanted:
            raise UserError(
                f"stage '{context.name}': the shards hold {stats.dim} features of {self.name} a frame, not "
                f"{wanted}; set width: {stats.dim}"
            )
        config = context.config
        if config.raw:
            stats = replace(stats, mean=np.zeros_like(stats.mean), std=np.ones_like(stats.std))
        replace(stats, rate=config.rate).save(context.folder / self.file)
        context.console.print(f"    {stats.frames} frames of {self.name}, {stats.dim} features")

    def preview(self, config: FeaturesConfig, given: Inputs) -> FeaturesPreview:
        return FeaturesPreview(config.width or self.width)

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> FrameStats:
        return FrameStats.load(stage.folder / self.file)

    def export(self, stage: CompletedStage, target: Path) -> None:
        copy_files(stage.folder, target, (self.file,))


MODALITIES.follow(lambda modality: modality.width is not None and register(FeaturesStage(modality)))
