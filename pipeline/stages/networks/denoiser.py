"""Base of stages of networks that denoise whole motions given a caption."""

from __future__ import annotations

from typing import TypeVar

import torch

from motionloom.models.diffusion.network import TextDenoiser, TextDenoiserConfig
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs
from motionloom.pipeline.inference.generators.diffusion import DiffusionMotion
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    part_columns,
    part_of,
)
from motionloom.pipeline.store.weights import ModelFacts, load_facts
from motionloom.pipeline.training.config import TrainConfig


class DenoiserStageConfig(CaptionStageConfig):
    """A denoiser conditioned on a sentence embedding; the defaults are MDM's but for the steps."""

    net: TextDenoiserConfig = TextDenoiserConfig()
    train: TrainConfig = TrainConfig(steps=200_000, batch_size=64)


D = TypeVar("D", bound=DenoiserStageConfig)
T = TypeVar("T", bound=TextDenoiser)


class DenoiserStage(CaptionStage[D, CaptionInputs, T]):
    """A stage of a `TextDenoiser`; subclasses name the network and build its module."""

    denoiser: type[T]
    offers = frozenset({GENERATOR})
    inputs = CaptionInputs
    curves = (Curve("loss"),)

    def facts(self, config: D, inputs: CaptionInputs) -> ModelFacts:
        layout = inputs.data.layout
        width = len(part_columns(layout, config.part))
        extra = {"motion_dim": width, "text_dim": inputs.text.dim, "part": config.part}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: CaptionInputs) -> T:
        config = type(self.config.model_fields["net"].default).parse(facts.config, facts.where)
        return self.denoiser(config, facts.fact("motion_dim", int), facts.fact("text_dim", int))

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        net = self.load(stage, given, device)
        part = part_of(load_facts(stage.folder))
        return DiffusionMotion(given["stats"].layout, part, given, net)
