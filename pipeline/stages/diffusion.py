"""Motion diffusion stage, of the face: the paper's second facial baseline (HumanTOMATO B.5.2)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from pydantic import Field, field_validator
from torch.utils.data import Dataset

from motionloom.datasets.loading.batches import CaptionBatches, EvalBatches
from motionloom.models.diffusion.module import DiffusionModule
from motionloom.models.diffusion.network import DiffusionConfig, MotionDiffusion
from motionloom.pipeline.stages.stage import StageContext
from motionloom.pipeline.stages.tma import part_columns
from motionloom.pipeline.stages.training import TrainConfig, TrainedStageConfig, fit
from motionloom.pipeline.store.data import held_out, open_split, open_stats, open_text
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts, save_model


class DiffusionStageConfig(TrainedStageConfig):
    """A denoiser of motions, told by a sentence embedding."""

    net: DiffusionConfig = DiffusionConfig()
    train: TrainConfig = TrainConfig(steps=200_000, batch_size=64)
    part: Literal["face"] = "face"
    """What is denoised: the face, told by the face captions."""
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


def run_diffusion(context: StageContext) -> None:
    """Train on whole clips and their captions."""
    config: DiffusionStageConfig = context.config
    data, stats, text = (
        context.input("data"),
        open_stats(context.input("stats")),
        open_text(context.input("text")),
    )
    dataset = open_split(data, "train", training=True)
    columns = part_columns(dataset.layout, config.part)
    torch.manual_seed(context.seed)
    net = MotionDiffusion(config.net, motion_dim=len(columns), text_dim=text.dim)
    module = DiffusionModule(net, config.optim, seed=context.seed, max_steps=config.train.steps)

    def train(batch: int, rank: int, world: int) -> Dataset[Any]:
        return CaptionBatches(
            dataset, stats, text, batch_size=batch, max_frames=config.max_frames,
            min_frames=config.min_frames, seed=context.seed, rank=rank, world=world, face=True,
            columns=columns,
        )  # fmt: skip

    held = open_split(data, held_out(data))

    def validation() -> Dataset[Any]:
        return EvalBatches(
            held, stats, text, batch_size=32, max_frames=config.max_frames, min_frames=config.min_frames,
            face=True, columns=columns,
        )  # fmt: skip

    fit(context, module, config.train, train, validation, config.optim.grad_clip)
    if module.global_rank == 0:
        extra = {"motion_dim": len(columns), "text_dim": text.dim, "part": config.part}
        layout = LayoutFacts.of(dataset.layout)
        save_model(
            context.folder,
            net,
            ModelFacts(kind="diffusion", config=config.net.dump(), layout=layout, extra=extra),
        )
