"""MotionDiffuse stage (HumanTOMATO Tables 1, 13 and 14)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionloom.datasets.conditions import Condition
from motionloom.models.diffusion.schedule import Sampler, by_length
from motionloom.models.layers.frozen import evaluating
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.baselines.motiondiffuse.network import MotionDiffuse, MotionDiffuseConfig
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, CompletedStage, Inputs, register
from motionloom.pipeline.inference.generators.diffusion import DenoisedMotion
from motionloom.pipeline.stages.networks.captions import (
    CaptionInputs,
    CaptionStage,
    CaptionStageConfig,
    part_columns,
    part_of,
)
from motionloom.pipeline.store.weights import ModelFacts, load_facts
from motionloom.pipeline.training.config import TrainConfig


@torch.no_grad()
def sample_motions(
    net: MotionDiffuse,
    text: Condition,
    frames: Sequence[int],
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddpm",
    steps: int = 50,
) -> list[Tensor]:
    """Normalised motions [T, D] for captions, one length and one seed each (`by_length`)."""
    with evaluating(net):
        read = net.read(text)

        def denoised(rows: list[int], x: Tensor, noise: list[torch.Generator]) -> Tensor:
            words = read.rows(rows)
            mask = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)

            def predict(given: Tensor, step: Tensor) -> Tensor:
                return net.denoise(given, step.to(x.device).expand(len(rows)), words, mask)

            return net.config.schedule.denoise(predict, x, noise, sampler, steps)

        return by_length(frames, seeds, net.motion_dim, text.features.device, denoised)


@dataclass(frozen=True)
class MotionDiffuseMotion(DenoisedMotion):
    """Denoising from the tokens of a caption, without guidance (MotionDiffuse)."""

    net: MotionDiffuse

    @property
    def max_frames(self) -> int:
        return self.net.max_frames

    def normalised(self, request: GenerationRequest, frames: Sequence[int]) -> list[Tensor]:
        sampler, steps = self.denoising(request.sampling)
        return sample_motions(
            self.net, request.text(self.who), frames, seeds=request.seeds, sampler=sampler, steps=steps
        )


class MotionDiffuseStageConfig(CaptionStageConfig):
    """A denoiser conditioned on the tokens of captions; the defaults are the paper's."""

    net: MotionDiffuseConfig = MotionDiffuseConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam", lr=2e-4, betas=(0.9, 0.999), grad_clip=0.5)
    train: TrainConfig = TrainConfig(steps=230_000, batch_size=1024)


class MotionDiffuseStage(CaptionStage[MotionDiffuseStageConfig, CaptionInputs, MotionDiffuse]):
    """A denoiser, trained on whole clips and the tokens of their captions."""

    name = "motiondiffuse"
    summary = "MotionDiffuse"
    version = 2  # feed-forwards begin at zero
    trainer = "motionloom.models.diffusion.module:DenoiserModule"
    config = MotionDiffuseStageConfig
    offers = frozenset({GENERATOR})
    inputs = CaptionInputs
    curves = (Curve("loss"),)

    def facts(self, config: MotionDiffuseStageConfig, inputs: CaptionInputs) -> ModelFacts:
        layout = inputs.data.layout
        width = len(part_columns(layout, config.part))
        extra = {"motion_dim": width, "text_dim": inputs.text.dim, "part": config.part}
        return ModelFacts.of(self.name, config.net, layout, {**extra, "max_frames": config.max_frames})

    def network(self, facts: ModelFacts, inputs: CaptionInputs) -> MotionDiffuse:
        config = MotionDiffuseConfig.parse(facts.config, facts.where)
        return MotionDiffuse(
            config, *(facts.fact(key, int) for key in ("motion_dim", "text_dim", "max_frames"))
        )

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        net = self.load(stage, given, device)
        part = part_of(load_facts(stage.folder))
        return MotionDiffuseMotion(given["stats"].layout, part, given, net)


register(MotionDiffuseStage())
