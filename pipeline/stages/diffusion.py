"""Motion diffusion stage, of the face: the paper's second facial baseline (HumanTOMATO B.5.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, field_validator
from torch import nn

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.network import DiffusionConfig, MotionDiffusion
from motionloom.models.diffusion.sampling import sample_motions
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Given
from motionloom.pipeline.stages.examples import caption_example
from motionloom.pipeline.stages.tma import caption_batches, part_columns
from motionloom.pipeline.stages.train_config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.stages.trained import Batches, Example, Say, TrainedStage
from motionloom.pipeline.store.networks import device_of
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts

if TYPE_CHECKING:
    from motionloom.models.diffusion.module import DiffusionModule


class DiffusionStageConfig(TrainedStageConfig):
    """A denoiser of motions, conditioned on a sentence embedding."""

    net: DiffusionConfig = DiffusionConfig()
    train: TrainConfig = TrainConfig(steps=200_000, batch_size=64)
    part: Literal["face"] = "face"
    """What is denoised: the face, conditioned on the face captions."""
    max_frames: int = Field(196, ge=8)
    """Longer clips are cropped at random."""
    min_frames: int = Field(16, ge=1)
    """Shorter clips are left out."""

    @field_validator("part", mode="before")
    @classmethod
    def _faces_only(cls, part: str) -> str:
        if part != "face":
            raise ValueError(f"a diffusion stage makes faces only, not {part}: leave `part` out")
        return part


class DiffusionStage(TrainedStage):
    """A denoiser, trained on whole clips and their captions."""

    name = "diffusion"
    summary = "motion diffusion"
    config = DiffusionStageConfig
    takes = ("data", "stats", "text")

    def gives(self, config: DiffusionStageConfig) -> frozenset[str]:
        """Motion of text."""
        return super().gives(config) | {GENERATOR}

    def facts(self, config: DiffusionStageConfig, given: Given) -> ModelFacts:
        """Config, layout and the widths of both sides."""
        layout = given["data"].layout
        width = len(part_columns(layout, config.part))
        extra = {"motion_dim": width, "text_dim": given["text"].dim, "part": config.part}
        return ModelFacts(
            kind="diffusion", config=config.net.dump(), layout=LayoutFacts.of(layout), extra=extra
        )

    def network(self, facts: ModelFacts, given: Given) -> MotionDiffusion:
        """The denoiser."""
        config = DiffusionConfig.parse(facts.config, facts.where)
        dims = (facts.fact(key, int) for key in ("motion_dim", "text_dim"))
        return MotionDiffusion(config, *dims)

    def module(self, config: DiffusionStageConfig, net: Any, given: Given, seed: int) -> DiffusionModule:
        """Squared error at a random time step."""
        from motionloom.models.diffusion.module import DiffusionModule

        return DiffusionModule(net, config.optim, seed=seed, max_steps=config.train.steps)

    def batches(
        self, config: DiffusionStageConfig, net: nn.Module, given: Given, seed: int, say: Say
    ) -> Batches:
        """Whole clips with one caption each."""
        return caption_batches(config, given, seed)

    def example(self, config: DiffusionStageConfig, net: Any, given: Given, batch: int) -> Example:
        """The longest clips with captions of usual length."""
        width = len(part_columns(given["data"].layout, config.part))
        return caption_example(batch, config.max_frames, width, given["text"].dim)

    def generator(self, stage: Finished, given: Given, device: torch.device) -> MotionGenerator:
        """Expressions from noise."""
        layout = given["stats"].layout
        return DiffusionFace(self.load(stage, given, device), layout, given)

    def exported(self, config: Any) -> tuple[str, ...]:
        """Statistics, and the encoder of its words."""
        return ("stats", "text")

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """The error."""
        return (Curve("loss"),)


@dataclass(frozen=True)
class DiffusionFace:
    """Denoising from a sentence embedding (B.5.2)."""

    net: MotionDiffusion
    layout: MotionLayout
    given: Mapping[str, Any]
    method = "diffusion"
    modalities = frozenset({"text"})
    settings = frozenset({"cfg_scale", "face_cfg_scale", "sampler", "denoising_steps"})
    unit_frames = 1
    max_frames = None
    part: Part = "face"

    @property
    def text(self) -> TextSource | None:
        """What encodes its words."""
        text: TextSource | None = self.given.get("text")
        return text

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """From noise, in as many steps as the request says."""
        if request.frames is None:
            raise UserError("the face's diffusion model makes a length that it is given, and none was")
        sampling = request.sampling
        made = sample_motions(
            self.net, request.pooled_text("the face's diffusion model").to(device_of(self.net)),
            request.frames, seeds=request.seeds, sampler=sampling.sampler, steps=sampling.denoising_steps,
            guidance=sampling.face_guidance,
        )  # fmt: skip
        columns = self.layout.part(self.part)
        values = [motion.cpu().numpy() for motion in made]
        return [np.asarray(self.given["stats"].denormalize(v, columns), dtype=np.float32) for v in values]
