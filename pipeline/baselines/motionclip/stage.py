"""MotionCLIP's stage: an auto-encoder of motion in the text stage's space of sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.models.layers.transformer import length_mask
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.motionclip.network import (
    MotionClip,
    MotionClipConfig,
    MotionClipLossConfig,
    SixD,
)
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, register
from motionloom.pipeline.inference.generators.base import WholeMotion
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    joint_loss_settings,
    part_columns,
)
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.store.weights import ModelFacts, load_facts
from motionloom.pipeline.training.config import TrainConfig


@dataclass(frozen=True)
class TextAsLatent(WholeMotion):
    """The sentence embedding is the latent, decoded as it stands (MotionCLIP): nothing is drawn."""

    net: MotionClip
    trained_frames: int
    who = "this MotionCLIP"
    method = "motionclip"

    @property
    def max_frames(self) -> int | None:
        """Return the longest of the training; the decoder makes longer motions stand still."""
        return self.trained_frames

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        text = request.pooled_text(self.who).to(device_of(self.net))
        mask = length_mask(torch.as_tensor(frames, device=text.device), max(frames))
        made = self.net.decode(text, mask)
        return [self.net.features(row[:count]) for row, count in zip(made, frames, strict=True)]


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
    trainer = "motionloom.pipeline.baselines.motionclip.module:MotionClipModule"
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

    def module_settings(
        self, config: MotionClipStageConfig, net: MotionClip, inputs: CaptionInputs
    ) -> dict[str, object]:
        return joint_loss_settings(inputs.data.layout, config.part, inputs.stats, config.loss)

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        facts = load_facts(stage.folder)
        layout = given["stats"].layout
        net = self.load(stage, given, device)
        return TextAsLatent(layout, "bodyhand", given, net, facts.fact("max_frames", int))


register(MotionClipStage())
