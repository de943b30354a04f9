"""The stage of the in-betweener, the network of `motionloom edit` [ours]."""

from __future__ import annotations

import torch

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import Part
from motionloom.pipeline.contract.stage import CompletedStage, Inputs, register
from motionloom.pipeline.editing.generator import InBetweenMotion
from motionloom.pipeline.editing.inbetween.network import InBetweenConfig, InBetweener
from motionloom.pipeline.editing.inbetween.observed import Observations
from motionloom.pipeline.stages.networks.captions import CaptionInputs, part_columns, part_of
from motionloom.pipeline.stages.networks.denoiser import DenoiserStage, DenoiserStageConfig
from motionloom.pipeline.store.weights import load_facts


class InBetweenStageConfig(DenoiserStageConfig):
    """A denoiser that observes a part of each motion, conditioned on a sentence embedding."""

    net: InBetweenConfig = InBetweenConfig()
    part: Part = "all"


class InBetweenStage(DenoiserStage[InBetweenStageConfig, InBetweener]):
    """Trains an in-betweener on whole clips and their captions."""

    name = "inbetween"
    summary = "motion in-betweening"
    trainer = "motionloom.pipeline.editing.inbetween.module:InBetweenModule"
    config = InBetweenStageConfig
    denoiser = InBetweener

    def module_settings(
        self, config: InBetweenStageConfig, net: InBetweener, inputs: CaptionInputs
    ) -> dict[str, object]:
        columns = part_columns(inputs.data.layout, config.part)
        # A dry run has no statistics.
        stats = inputs.stats or FeatureStats.unit(inputs.data.layout)
        share = config.net.observed_share
        return {"observations": Observations(stats.layout, columns, stats.mean, stats.std, share)}

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> InBetweenMotion:
        net = self.load(stage, given, device)
        part = part_of(load_facts(stage.folder))
        return InBetweenMotion(given["stats"].layout, part, given, net, stage.config.max_frames)


register(InBetweenStage())
