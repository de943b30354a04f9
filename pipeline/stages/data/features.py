"""Statistics of a modality's features, by which networks read it normalised (UDE section 4.1, of music)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from motionloom.datasets.loading.statistics import frame_statistics
from motionloom.datasets.modalities.modality import FrameStats, Modality
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.pipeline.contract.stage import (
    Finished,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.files import copy_files


class FeaturesConfig(StageConfig):
    """Nothing to choose: the features are those of the shards."""


@dataclass(frozen=True)
class FeaturesPreview:
    """What is known of the statistics before the stage has run."""

    dim: int


class FeaturesStage(StageKind[FeaturesConfig]):
    """Mean and deviation of every feature of one modality over the training split."""

    config = FeaturesConfig
    takes = ("data",)

    def __init__(self, modality: Modality) -> None:
        assert modality.width is not None
        self.name, self.modality, self.width = modality.name, modality, modality.width
        self.summary = f"statistics of {modality.name} features"
        self.file = f"{modality.name}.safetensors"

    def run(self, context: StageContext) -> None:
        stats = frame_statistics(context.given["data"].split("train"), self.modality)
        stats.save(context.folder / self.file)
        context.console.print(f"    {stats.frames} frames of {self.name}, {stats.dim} features")

    def preview(self, config: FeaturesConfig, given: Inputs) -> FeaturesPreview:
        return FeaturesPreview(self.width)

    def load(self, stage: Finished, given: Inputs, device: torch.device) -> FrameStats:
        return FrameStats.load(stage.folder / self.file)

    def export(self, stage: Finished, target: Path) -> None:
        copy_files(stage.folder, target, (self.file,))


for _modality in MODALITIES.values():
    if _modality.width is not None:
        register(FeaturesStage(_modality))
