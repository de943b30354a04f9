"""Statistics of audio features, which a model of music normalises what it hears by (UDE section 4.1)."""

from __future__ import annotations

from pathlib import Path

import torch

from motionloom.datasets.loading.audio_statistics import AudioStats, compute_audio
from motionloom.pipeline.contract.stage import Finished, Given, StageConfig, StageContext, StageKind
from motionloom.pipeline.store.files import copy_files

AUDIO_WIDTH = 438
_STATS = "audio.safetensors"


class AudioConfig(StageConfig):
    """Nothing to choose: the features are those of the shards."""


class AudioPreview:
    """What is known of it before it has run."""

    dim = AUDIO_WIDTH


class AudioStage(StageKind):
    """Mean and deviation of every audio feature of the training split."""

    name = "audio"
    summary = "statistics of audio features"
    config = AudioConfig
    takes = ("data",)

    def run(self, context: StageContext) -> None:
        """One pass over the clips with music."""
        stats = compute_audio(context.given["data"].split("train"))
        stats.save(context.folder / _STATS)
        context.console.print(f"    {stats.frames} frames of music, {stats.dim} features")

    def preview(self, config: AudioConfig, given: Given) -> AudioPreview:
        """Its width."""
        return AudioPreview()

    def load(self, stage: Finished, given: Given, device: torch.device) -> AudioStats:
        """The statistics."""
        return AudioStats.load(stage.folder / _STATS)

    def export(self, stage: Finished, target: Path) -> None:
        """The statistics."""
        copy_files(stage.folder, target, (_STATS,))
