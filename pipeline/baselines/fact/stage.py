"""FACT stage: the next frames of a dance from those before and the music (AI Choreographer, UDE Table 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.layout import Part
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.fact.network import Fact, FactConfig
from motionloom.pipeline.contract.generation import Capabilities, GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, register
from motionloom.pipeline.inference.generators.base import DanceGenerator
from motionloom.pipeline.stages.networks.captions import part_columns, part_of
from motionloom.pipeline.stages.networks.clips import MUSIC, clip_batches, motion_example, spread_dances
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage


@dataclass(frozen=True)
class FactGenerator(DanceGenerator):
    """Dances frame by frame; of the inputs "stats" is read too."""

    net: Fact
    part: Part
    method = "fact"
    unit_frames = 1

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(seed_frames=self.net.config.motion_frames)

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Features in their own units; without seed motions each goes on from a kept one, by its seed."""
        lengths = request.lengths("FACT")
        columns = self.layout.part(self.part)
        stats = self.given["stats"]
        mean = stats.mean[columns]
        std = stats.std[columns]
        if request.seed_motions is None:
            begun = self.net.kept[[seed % len(self.net.kept) for seed in request.seeds]]
        else:
            begun = torch.from_numpy((np.stack(list(request.seed_motions)) - mean) / std)
        made = self.net.go_on(begun.to(device_of(self.net), torch.float32), self.music(request), max(lengths))
        own = np.asarray(made.cpu().numpy() * std + mean, np.float32)
        return [motion[:count] for motion, count in zip(own, lengths, strict=True)]


class FactStageConfig(TrainedStageConfig):
    """FACT; the defaults are the published ones."""

    net: FactConfig = FactConfig()
    optim: OptimConfig = OptimConfig(
        optimizer="adam", lr=1e-4, betas=(0.9, 0.999), drop_at=(100_000, 150_000), grad_clip=0.0
    )
    train: TrainConfig = TrainConfig(steps=300_000, batch_size=32)
    part: Part = "bodyhand"
    """Columns of the layout."""
    kept: int = Field(8, ge=1)
    """Motions of the training set that it keeps to go on from, where none is given."""


class FactInputs(Inputs):
    """Dances, their statistics and their music."""

    data: Data
    stats: FeatureStats
    audio: FrameStats


class FactStage(TrainedStage[FactStageConfig, FactInputs, Fact]):
    """Music and the start of a dance to the rest of it."""

    name = "fact"
    summary = "FACT: music and a start to a dance"
    trainer = "motionloom.pipeline.baselines.fact.module:FactModule"
    config = FactStageConfig
    offers = frozenset({GENERATOR})
    inputs = FactInputs
    curves = (Curve("loss"),)
    exports = ("stats", "audio")

    def facts(self, config: FactStageConfig, inputs: FactInputs) -> ModelFacts:
        layout = inputs.data.layout
        part_columns(layout, config.part)
        extra = {"part": config.part, "music_dim": inputs.audio.dim, "kept": config.kept}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: FactInputs) -> Fact:
        config = FactConfig.parse(facts.config, facts.where)
        layout = facts.layout.layout()
        sizes = {name: facts.fact(name, int) for name in ("music_dim", "kept")}
        return Fact(config, layout, part_of(facts), **sizes)

    def prepare(self, config: FactStageConfig, net: Fact, inputs: FactInputs) -> None:
        """Statistics for matrices, and starts of training dances."""
        stats = inputs.stats
        columns = inputs.data.layout.part(config.part)
        net.columns.learn(torch.from_numpy(stats.mean[columns]), torch.from_numpy(stats.std[columns]))
        dataset = inputs.data.split("train")
        frames = config.net.motion_frames
        for row, clip in enumerate(spread_dances(dataset, config.kept, config.net.clip_frames)):
            start = stats.normalize(dataset.motion(clip)[:frames])[:, columns]
            net.kept[row] = torch.from_numpy(start)

    def batches(self, config: FactStageConfig, net: Fact, inputs: FactInputs, seed: int, log: Log) -> Batches:
        columns = inputs.data.layout.part(config.part)
        frames = {"max_frames": config.net.window_frames, "min_frames": config.net.clip_frames}
        readers = {"audio": inputs.audio}
        return clip_batches(
            inputs.data, inputs.stats, readers, seed, clips={"columns": columns, **frames}, balance=MUSIC
        )

    def example(self, config: FactStageConfig, net: Fact, inputs: FactInputs, batch: int) -> Example:
        frames = config.net.window_frames
        width = len(inputs.data.layout.part(config.part))
        music = MODALITIES["audio"].example(batch, frames, inputs.audio.dim)
        note = f"{config.net.motion_frames} frames of motion + {config.net.music_frames} of music"
        return Example(motion_example(batch, frames, width, conditions={"audio": music}), note)

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        return FactGenerator(given["stats"].layout, given, self.load(stage, given, device), stage.config.part)


register(FactStage())
