"""Tokenizer stages: H2VQ, VQ, RVQ; body-hand, body only or face (HumanTOMATO section 3.2, appendix B.2)."""

from __future__ import annotations

from typing import Any

import torch
from pydantic import Field
from torch.utils.data import Dataset

from motionloom.datasets.loading.batches import EvalBatches, WindowBatches
from motionloom.datasets.schema import UserError
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import (
    AnyTokenizerConfig,
    EmaTokenizerConfig,
    FsqConfig,
    H2VQConfig,
    RvqConfig,
    SeparateConfig,
    VqConfig,
)
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.stage import StageContext
from motionloom.pipeline.stages.training import TrainConfig, TrainedStageConfig, fit
from motionloom.pipeline.store.data import held_out, open_split, open_stats
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts, save_model


class _TokenizerStageConfig(TrainedStageConfig):
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=256)
    window: int = Field(64, ge=4, multiple_of=4)
    """Frames of a training window."""
    windows_per_clip: int = Field(1, ge=1)
    """Windows cut from one read of a clip."""
    net: AnyTokenizerConfig

    def require_fit(self, hardware: Hardware) -> None:
        """A codebook must get several times the vectors that it resets codes below."""
        super().require_fit(hardware)
        if not isinstance(self.net, EmaTokenizerConfig):
            return
        vectors = self.train.batch_size // self.train.accumulate * self.window // GROUP_FRAMES
        needed = 2 * self.net.num_codes * self.net.reset_below
        if vectors < needed:
            raise UserError(
                f"a codebook of {self.net.num_codes} codes gets {vectors} vectors an update and resets codes "
                f"used less than {self.net.reset_below:g} times: it would replace codes for ever. Set "
                f"net.reset_below to {vectors / self.net.num_codes / 4:.2g} or less, or raise "
                "train.batch_size"
            )


class H2VQStageConfig(_TokenizerStageConfig):
    """Body and hand codebooks with their hierarchy."""

    net: H2VQConfig = H2VQConfig()


class VqStageConfig(_TokenizerStageConfig):
    """One codebook."""

    net: VqConfig = VqConfig()


class RvqStageConfig(_TokenizerStageConfig):
    """Residual codebooks (body-only data, face)."""

    net: RvqConfig = RvqConfig()


class SeparateStageConfig(_TokenizerStageConfig):
    """Body and hands apart, the ablation of H2VQ."""

    net: SeparateConfig = SeparateConfig()


class FsqStageConfig(_TokenizerStageConfig):
    """Finite scalar quantization."""

    net: FsqConfig = FsqConfig()


def run_tokenizer(context: StageContext) -> None:
    """Train a tokenizer on windows of the training split."""
    config = context.config
    data, stats = context.input("data"), open_stats(context.input("stats"))
    dataset = open_split(data, "train", training=True)
    torch.manual_seed(context.seed)
    net = build_tokenizer(config.net, dataset.layout)
    columns = net.columns.numpy()
    net.basis.learn(stats.mean[columns], stats.std[columns])
    module = TokenizerModule(
        net, config.optim, seed=context.seed, max_steps=config.train.steps, **config.net.loss_terms()
    )

    def train(batch: int, rank: int, world: int) -> Dataset[Any]:
        return WindowBatches(
            dataset,
            stats,
            window=config.window,
            batch_size=batch,
            windows_per_clip=config.windows_per_clip,
            seed=context.seed,
            rank=rank,
            world=world,
            columns=columns,
        )

    held = open_split(data, held_out(data))

    def validation() -> Dataset[Any]:
        return EvalBatches(
            held,
            stats,
            batch_size=64,  # enough tokens that its perplexity compares with training's
            max_frames=4 * config.window,
            columns=columns,
        )

    fit(context, module, config.train, train, validation, config.optim.grad_clip)
    if module.global_rank == 0:
        facts = ModelFacts(
            kind=config.net.kind, config=config.net.dump(), layout=LayoutFacts.of(dataset.layout)
        )
        save_model(context.folder, net, facts)
