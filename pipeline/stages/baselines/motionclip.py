"""MotionCLIP's stage: an auto-encoder of motion in the text stage's space of sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

from motionloom.datasets.schema import UserError
from motionloom.models.baselines.motionclip.network import MotionClip, MotionClipConfig, MotionClipLossConfig
from motionloom.models.baselines.motionclip.sixd import SixD
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Inputs, register
from motionloom.pipeline.inference.generators.vae import TextAsLatent
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    part_columns,
    part_statistics,
)
from motionloom.pipeline.store.weights import ModelFacts, load_facts
from motionloom.pipeline.training.config import TrainConfig

if TYPE_CHECKING:
    from motionloom.models.baselines.motionclip.module import MotionClipModule


class MotionClipStageConfig(CaptionStageConfig):
    """An auto-encoder of body and hands under a frozen text encoder."""

    net: MotionClipConfig = MotionClipConfig()
    loss: MotionClipLossConfig = MotionClipLossConfig()
    optim: OptimConfig = OptimConfig(weight_decay=0.01, betas=(0.9, 0.999))
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=20)
    max_frames: int = 60
    """Longer clips are cropped at random, and no longer motion can be made."""
    part: Literal["bodyhand"] = "bodyhand"


class MotionClipStage(CaptionStage[MotionClipStageConfig, CaptionInputs, MotionClip]):
    """Trained on whole clips and their captions."""

    name = "motionclip"
    summary = "auto-encoder in the space of texts (MotionCLIP)"
    config = MotionClipStageConfig
    offers = frozenset({GENERATOR})
    inputs = CaptionInputs
    curves = tuple(Curve(name) for name in ("features", "joints", "text"))

    def facts(self, config: MotionClipStageConfig, inputs: CaptionInputs) -> ModelFacts:
        layout = inputs.data.layout
        if config.net.latent != inputs.text.dim:
            raise UserError(
                f"net.latent {config.net.latent} must be the width of the text stage's sentence embeddings: "
                f"set it to {inputs.text.dim}"
            )
        extra = {"motion_dim": len(part_columns(layout, config.part)), "max_frames": config.max_frames}
        return ModelFacts.of(self.name, config.net, layout, extra)

    def network(self, facts: ModelFacts, inputs: CaptionInputs) -> MotionClip:
        layout = facts.layout.layout()
        sixd = SixD(layout) if layout.name == "smpl75" else None
        config = MotionClipConfig.parse(facts.config, facts.where)
        return MotionClip(config, facts.fact("motion_dim", int), sixd)

    def prepare(self, config: MotionClipStageConfig, net: MotionClip, inputs: CaptionInputs) -> None:
        """Rotations are read in their own units, which are known by how columns were normalised."""
        if net.sixd is not None:
            net.sixd.learn(inputs.stats.mean, inputs.stats.std)

    def module(
        self, config: MotionClipStageConfig, net: MotionClip, inputs: CaptionInputs, seed: int
    ) -> MotionClipModule:
        from motionloom.models.baselines.motionclip.module import MotionClipModule

        layout = inputs.data.layout
        mean, std = part_statistics(layout, config.part, inputs.stats)
        return MotionClipModule(
            net, config.optim, seed=seed, max_steps=config.train.steps, layout=layout,
            mean=mean, std=std, loss=config.loss,
        )  # fmt: skip

    def generator(self, stage: Finished, given: Inputs, device: torch.device) -> MotionGenerator:
        facts, layout = load_facts(stage.folder), given["stats"].layout
        net = self.load(stage, given, device)
        return TextAsLatent(layout, "bodyhand", given, net, facts.fact("max_frames", int))


register(MotionClipStage())
