"""DMD stage: the diffusion decoder of motion tokens (UDE section 3.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from pydantic import Field
from torch import nn

from motionloom.datasets.schema import UserError
from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import Given
from motionloom.pipeline.stages.streams import require_streams, stream_facts
from motionloom.pipeline.stages.train_config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.stages.trained import Batches, Example, Say, TrainedStage
from motionloom.pipeline.stages.windows import window_batches
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts

if TYPE_CHECKING:
    from motionloom.models.diffusion.dmd_module import DmdModule


class DmdStageConfig(TrainedStageConfig):
    """A diffusion decoder of the tokens of one tokenizer."""

    net: DmdConfig = DmdConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam")
    train: TrainConfig = TrainConfig(steps=200_000, batch_size=64)
    window: int = Field(160, ge=8, multiple_of=4)
    """Frames of a training window; longer motions are decoded in overlapping windows of this size."""
    windows_per_clip: int = Field(1, ge=1)
    """Windows cut from one read of a clip."""


@dataclass(frozen=True)
class LoadedDmd:
    """A trained decoder."""

    net: Dmd
    window: int
    given: Mapping[str, Any]
    """What its stage was given; "tokenizer" of it."""


class DmdStage(TrainedStage):
    """Tokens to varied motion."""

    name = "dmd"
    summary = "diffusion decoder of motion tokens"
    config = DmdStageConfig
    takes = ("data", "stats", "tokenizer")
    version = 2  # the tokenizer's coordinates

    def gives(self, config: Any) -> frozenset[str]:
        """Motion of tokens."""
        return super().gives(config) | {"decoder"}

    def facts(self, config: DmdStageConfig, given: Given) -> ModelFacts:
        """Config and the tokenizer's streams."""
        tokenizer = given["tokenizer"].net
        if config.net.schedule.predicts == "epsilon" and config.net.dim < tokenizer.dim:
            raise UserError(
                f"net.dim {config.net.dim} cannot carry the noise of {tokenizer.dim} columns, and a network "
                f"that predicts the noise has to give back: raise net.dim to {tokenizer.dim} or more, or set "
                f"net.schedule.predicts: sample"
            )
        extra = {**stream_facts(tokenizer), "window": config.window}
        layout = LayoutFacts.of(given["data"].layout)
        return ModelFacts(kind="dmd", config=config.net.dump(), layout=layout, extra=extra)

    def network(self, facts: ModelFacts, given: Given) -> Dmd:
        """The denoiser of the tokenizer's columns given its tokens."""
        tokenizer = given["tokenizer"].net
        require_streams(facts, tokenizer, "decoder")
        config = DmdConfig.parse(facts.config, facts.where)
        return Dmd(config, tokenizer.streams, tokenizer.pattern, tokenizer.dim)

    def module(self, config: DmdStageConfig, net: Any, given: Given, seed: int) -> DmdModule:
        """Squared error of the noise."""
        from motionloom.models.diffusion.dmd_module import DmdModule

        return DmdModule(
            net, config.optim, seed=seed, max_steps=config.train.steps, tokenizer=given["tokenizer"].net
        )

    def batches(self, config: DmdStageConfig, net: nn.Module, given: Given, seed: int, say: Say) -> Batches:
        """Windows of motion; their tokens are made as they come."""
        columns, window = given["tokenizer"].columns, config.window
        return window_batches(
            config, given, columns, seed, batch_size=32, max_frames=window, min_frames=GROUP_FRAMES
        )

    def example(self, config: DmdStageConfig, net: Any, given: Given, batch: int) -> Example:
        """The longest windows."""
        return Example(
            {
                "motion": torch.empty(batch, config.window, net.motion_dim),
                "length": torch.full((batch,), config.window),
            }
        )

    def loaded(self, net: Dmd, facts: ModelFacts, given: Given) -> LoadedDmd:
        """The network and its window."""
        return LoadedDmd(net, facts.fact("window", int), given)

    def exported(self, config: Any) -> tuple[str, ...]:
        """The tokenizer, whose statistics turn what it makes into metres."""
        return ("tokenizer",)

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """The error."""
        return (Curve("loss"),)
