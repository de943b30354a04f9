"""The stages and the generator; `register` is all that makes them known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionloom import register
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs
from motionloom.pipeline.inference.generators.base import WholeMotion
from motionloom.pipeline.stages.networks.captions import CaptionInputs, CaptionStage, CaptionStageConfig
from motionloom.pipeline.stages.networks.tma import TmaStage
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig
from sway.network import Sway, SwayNetConfig


class SwayConfig(CaptionStageConfig):
    """A recipe's `kind: sway`; `optim`, `train`, `part` and lengths come with the base class."""

    net: SwayNetConfig = SwayNetConfig()
    train: TrainConfig = TrainConfig(steps=1000, batch_size=16)


@dataclass(frozen=True)
class SwayMotion(WholeMotion):
    """Motion of text, as long as it is asked for."""

    net: Sway
    who = "sway"
    method = "sway"

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        """Each row from its own seed, so what it is batched with plays no part."""
        made = []
        for row, (sentence, count) in enumerate(zip(request.pooled_text(self.who), frames, strict=True)):
            draws = torch.Generator().manual_seed(request.seeds[row])
            noise = torch.randn(1, self.net.noise, generator=draws).to(sentence.device)
            made.append(self.net(sentence[None], noise, count)[0])
        return made


class SwayStage(CaptionStage[SwayConfig, CaptionInputs, Sway]):
    """Text to motion; `CaptionStage` brings the batches."""

    name = "sway"
    summary = "text to swaying motion"
    trainer = "sway.losses:SwayModule"
    config = SwayConfig
    inputs = CaptionInputs
    offers = frozenset({GENERATOR})
    curves = (Curve("place"), Curve("speed", "speed, apart from the recording's"))

    def facts(self, config: SwayConfig, inputs: CaptionInputs) -> ModelFacts:
        """Written beside the weights: all that `network` needs."""
        columns = len(inputs.data.layout.part(config.part))
        return ModelFacts.of(
            self.name, config.net, inputs.data.layout, {"text": inputs.text.dim, "motion": columns}
        )

    def network(self, facts: ModelFacts, inputs: CaptionInputs) -> Sway:
        """For training, for the dry run and for loading."""
        config = SwayNetConfig.parse(facts.config, facts.where)
        return Sway(config, facts.fact("text", int), facts.fact("motion", int))

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        """From a run and from an export alike."""
        return SwayMotion(given["stats"].layout, stage.config.part, given, self.load(stage, given, device))


class TightTmaStage(TmaStage):
    """TMA with one more loss; stands wherever a recipe or an evaluation wants a `tma`."""

    name = "tight_tma"
    summary = "text-motion alignment of short texts"
    trainer = "sway.losses:TightTmaModule"


register(SwayStage())
register(TightTmaStage())
