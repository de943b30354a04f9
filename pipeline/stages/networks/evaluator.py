"""The generic text-motion evaluator (Guo et al., CVPR 2022), trained on a run's own data."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.evaluator.losses import MATCHING, MOVEMENT, EvaluatorLossConfig
from motionloom.models.evaluator.network import UNIT, Evaluator, EvaluatorConfig
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import register
from motionloom.pipeline.stages.networks.captions import CaptionInputs, CaptionStage, CaptionStageConfig
from motionloom.pipeline.store.evaluator import LoadedEvaluator, StageWords
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig


class EvaluatorStageConfig(CaptionStageConfig):
    """The evaluator that the field's FID and R-Precision are measured with, for this run's data.

    Losses, sizes and optimizer are the published ones. Batches are whole clips for the autoencoder too, and
    the number of its steps is ours, as the published code counts epochs over windows.
    """

    part: Literal["bodyhand"] = "bodyhand"

    net: EvaluatorConfig = EvaluatorConfig()
    loss: EvaluatorLossConfig = EvaluatorLossConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam", lr=1e-4, betas=(0.9, 0.999), grad_clip=0.5)
    movement_optim: OptimConfig = OptimConfig(optimizer="adam", lr=1e-4, betas=(0.9, 0.999), grad_clip=0.0)
    """Optimizer of the movement autoencoder."""
    movement_steps: int = Field(40_000, ge=1)
    """Steps of the autoencoder, the first of `train.steps`; the two GRUs are trained in those behind."""
    train: TrainConfig = TrainConfig(steps=260_000, batch_size=32)
    max_frames: int = Field(196, ge=UNIT, multiple_of=UNIT)
    """Longer clips are cropped at random."""
    min_frames: int = Field(16, ge=UNIT)
    """Shorter clips are left out; the published evaluator takes 40."""

    @model_validator(mode="after")
    def _can_be_trained(self) -> Self:
        if self.movement_steps >= self.train.steps:
            raise ValueError(
                f"movement_steps {self.movement_steps} leave none of train.steps {self.train.steps} for the "
                f"pairs; lower movement_steps"
            )
        if self.train.batch_size // self.train.accumulate < 2:
            raise ValueError("a batch of one clip has no mismatching pair; raise train.batch_size")
        return self


class EvaluatorStage(CaptionStage[EvaluatorStageConfig, CaptionInputs, Evaluator]):
    """A judge of text and motion that no generator is trained with."""

    name = "evaluator"
    summary = "text-motion evaluator"
    trainer = "motionloom.models.evaluator.module:EvaluatorModule"
    config = EvaluatorStageConfig
    inputs = CaptionInputs
    curves = (
        Curve(f"{MOVEMENT}_reconstruction", "error of the movement autoencoder"),
        Curve(f"{MATCHING}_loss", "margin loss"),
        Curve(f"{MATCHING}_own", "distance of a caption from its motion"),
        Curve(f"{MATCHING}_other", "distance of a caption from other motions"),
    )

    def facts(self, config: EvaluatorStageConfig, inputs: CaptionInputs) -> ModelFacts:
        text = inputs.text
        extra = {
            "text_dim": text.dim,
            "encoder": text.cache.encoder if isinstance(text, TextSource) else "",
            "max_frames": config.max_frames,
        }
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: CaptionInputs) -> Evaluator:
        config = EvaluatorConfig.parse(facts.config, facts.where)
        frames = facts.fact("max_frames", int)
        return Evaluator(config, facts.layout.layout(), facts.fact("text_dim", int), frames)

    def loaded(self, net: Evaluator, facts: ModelFacts, inputs: CaptionInputs) -> LoadedEvaluator:
        layout: MotionLayout = facts.layout.layout()
        stats = inputs.stats
        if stats is not None and stats.layout != layout:
            raise UserError(
                f"{facts.where}: this evaluator was trained on layout {layout.name} at {layout.fps:g} fps "
                f"and is given statistics of {stats.layout.name} at {stats.layout.fps:g} fps; train it again"
            )
        words = StageWords(inputs.text, facts.fact("encoder", str), facts.where)
        return LoadedEvaluator(net, layout, stats, words)


register(EvaluatorStage())
