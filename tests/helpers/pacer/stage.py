"""The stage: `register` is all that makes it known."""

from __future__ import annotations

import torch

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, register
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts, Release
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage
from pacer.batches import PacerBatches, PacerInputs
from pacer.generator import PacerGenerator
from pacer.module import PacerConfig, PacerModule
from pacer.network import PART, Pacer, PacerNetConfig


class PacerStage(TrainedStage[PacerConfig, PacerInputs, Pacer]):
    """Music to motion."""

    name = "pacer"
    summary = "motion paced by music"
    config = PacerConfig
    offers = frozenset({GENERATOR})
    inputs = PacerInputs
    curves = (Curve("pacer_distance"), Curve("critic_margin", "margin of the critic"))

    def facts(self, config: PacerConfig, inputs: PacerInputs) -> ModelFacts:
        """Written beside the weights: with the stages of `exported`, all that `network` needs."""
        layout, extra = LayoutFacts.of(inputs.data.layout), {"audio": inputs.audio.dim}
        return ModelFacts(kind=self.name, config=config.net.dump(), layout=layout, extra=extra)

    def network(self, facts: ModelFacts, inputs: PacerInputs) -> Pacer:
        """For training, for the dry run and for loading."""
        config = PacerNetConfig.parse(facts.config, facts.where)
        return Pacer(config, facts.fact("audio", int), len(facts.layout.layout().part(PART)))

    def release(self, net: Pacer) -> Release:
        """The names that published weights have for the network's."""
        return Release({name: f"generator.{name}" for name in net.state_dict()}, unread=("critic.*",))

    def module(self, config: PacerConfig, net: Pacer, inputs: PacerInputs, seed: int) -> PacerModule:
        """The generator and its critic."""
        return PacerModule(net, config, seed)

    def batches(self, config: PacerConfig, net: Pacer, inputs: PacerInputs, seed: int, log: Log) -> Batches:
        """Windows of clips with music."""
        data, window = inputs.data, config.window

        def train(batch: int, rank: int, world: int) -> PacerBatches:
            return PacerBatches(data.split("train"), inputs, window, batch, seed, rank, world)

        return Batches(train, lambda: PacerBatches(data.held_out(), inputs, window, 8, seed))

    def example(self, config: PacerConfig, net: Pacer, inputs: PacerInputs, batch: int) -> Example:
        """Shapes alone: the dry run has no data."""
        both = {name: torch.empty(batch, config.window, getattr(net, name)) for name in ("motion", "audio")}
        length = torch.full((batch,), config.window)
        return Example({**both, "length": length}, f"{config.window} frames")

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        """From a run and from an export alike."""
        stats: FeatureStats = given["stats"]
        return PacerGenerator(self.load(stage, given, device), stats.layout, stats, given["audio"])

    def exported(self, config: PacerConfig) -> tuple[str, ...]:
        """Stages that an export takes along."""
        return ("stats", "audio")


register(PacerStage())
