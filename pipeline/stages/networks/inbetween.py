"""The stage of the in-betweener, the network of `motionloom edit` [ours]."""

from __future__ import annotations

from typing import TYPE_CHECKING

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import Part
from motionloom.models.diffusion.network import InBetweenConfig, InBetweener
from motionloom.models.diffusion.observed import Observations
from motionloom.pipeline.contract.stage import register
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    DenoiserStage,
    DenoiserStageConfig,
    part_columns,
)

if TYPE_CHECKING:
    from motionloom.models.diffusion.module import InBetweenModule


class InBetweenStageConfig(DenoiserStageConfig):
    """A denoiser that observes a part of each motion, conditioned on a sentence embedding."""

    net: InBetweenConfig = InBetweenConfig()
    part: Part = "all"


class InBetweenStage(DenoiserStage[InBetweenStageConfig, InBetweener]):
    """Trains an in-betweener on whole clips and their captions."""

    name = "inbetween"
    summary = "motion in-betweening"
    config = InBetweenStageConfig
    denoiser = InBetweener

    def module(
        self, config: InBetweenStageConfig, net: InBetweener, inputs: CaptionInputs, seed: int
    ) -> InBetweenModule:
        from motionloom.models.diffusion.module import InBetweenModule

        columns = part_columns(inputs.data.layout, config.part)
        # A dry run has no statistics.
        stats = inputs.stats or FeatureStats.unit(inputs.data.layout)
        share = config.net.observed_share
        observations = Observations.of(stats.layout, columns, stats.mean, stats.std, share)
        return InBetweenModule(
            net, config.optim, seed=seed, max_steps=config.train.steps, observations=observations
        )


register(InBetweenStage())
