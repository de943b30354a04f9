"""Text-motion alignment stage (HumanTOMATO section 3.5, appendix D)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch.utils.data import Dataset

from motionloom.datasets.loading.batches import CaptionBatches, EvalBatches
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import UserError
from motionloom.models.tma.module import TmaLossConfig, TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.pipeline.stages.stage import StageContext
from motionloom.pipeline.stages.training import TrainConfig, TrainedStageConfig, fit
from motionloom.pipeline.store.data import held_out, open_split, open_stats, open_text
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts, save_model


class TmaStageConfig(TrainedStageConfig):
    """Motion and text encoders in one latent space."""

    net: TmaConfig = TmaConfig()
    loss: TmaLossConfig = TmaLossConfig()
    train: TrainConfig = TrainConfig(steps=50_000, batch_size=256)
    max_frames: int = Field(196, ge=8)
    """Longer clips are cropped at random."""
    min_frames: int = Field(16, ge=1)
    """Shorter clips are left out."""
    part: Literal["bodyhand", "face"] = "bodyhand"
    """What is aligned; `face` takes the face captions. Without InfoNCE (`loss.contrastive: 0`) it is TEMOS,
    or, of the face, the paper's facial cVAE (B.5.1)."""

    @model_validator(mode="after")
    def _faces_have_every_frame(self) -> TmaStageConfig:
        if self.part == "face" and self.net.frame_stride != 1:
            raise ValueError("a face is generated frame by frame: net.frame_stride must be 1 with part: face")
        return self


def part_columns(layout: MotionLayout, part: Part) -> NDArray[np.int64]:
    """Columns of one part of a layout, which must have it."""
    if not layout.has_part(part):
        raise UserError(f"layout {layout.name} has no {part} columns; choose another part or data set")
    return layout.part(part)


def run_tma(context: StageContext) -> None:
    """Train the alignment model on whole clips and their captions."""
    config = context.config
    data, stats, text = (
        context.input("data"),
        open_stats(context.input("stats")),
        open_text(context.input("text")),
    )
    dataset = open_split(data, "train", training=True)
    columns = part_columns(dataset.layout, config.part)
    torch.manual_seed(context.seed)
    net = Tma.of_layout(config.net, dataset.layout, config.part, text.dim)
    if net.basis is not None:
        net.basis.learn(stats.mean[columns], stats.std[columns])
    module = TmaModule(net, config.optim, seed=context.seed, max_steps=config.train.steps, loss=config.loss)

    def train(batch: int, rank: int, world: int) -> Dataset[Any]:
        return CaptionBatches(
            dataset,
            stats,
            text,
            batch_size=batch,
            max_frames=config.max_frames,
            min_frames=config.min_frames,
            seed=context.seed,
            rank=rank,
            world=world,
            face=config.part == "face",
            columns=columns,
        )

    held = open_split(data, held_out(data))

    def validation() -> Dataset[Any]:
        return EvalBatches(
            held,
            stats,
            text,
            batch_size=32,
            max_frames=config.max_frames,
            min_frames=config.min_frames,
            face=config.part == "face",
            columns=columns,
        )

    fit(context, module, config.train, train, validation, config.optim.grad_clip)
    if module.global_rank == 0:
        extra = {"text_dim": text.dim, "max_frames": config.max_frames, "part": config.part}
        facts = ModelFacts(
            kind="tma", config=config.net.dump(), layout=LayoutFacts.of(dataset.layout), extra=extra
        )
        save_model(context.folder, net, facts)
