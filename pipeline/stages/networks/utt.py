"""UTT stage: MATE and the token transformer, end to end against a discriminator (UDE sections 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from pydantic import Field, field_validator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.kinds import Balance, Drop
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.models.condition.mate import MateConfig
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.training.optim import OptimConfig
from motionloom.models.utt.network import ConditionedUtt, UttConfig, UttLossConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import Every, Inputs, Role, Stage, register
from motionloom.pipeline.stages.networks.clips import clip_batches, motion_example
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.networks import LoadedWindowed, TrainedTokenizer, require_streams, stream_facts
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage

if TYPE_CHECKING:
    from motionloom.models.training.stage_module import StageModule


class UttStageConfig(TrainedStageConfig):
    """MATE and UTT."""

    net: UttConfig = UttConfig()
    mate: MateConfig = MateConfig()
    loss: UttLossConfig = UttLossConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam")
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=64)
    modalities: tuple[str, ...] = ("text", "audio")
    """Conditioning modalities, of `datasets/modalities/`; each needs the stage of its name."""
    max_frames: int = Field(160, ge=8, multiple_of=4)
    """Longest window of a clip."""
    min_frames: int = Field(16, ge=4)
    """Shorter clips are left out."""
    balance: Balance | None = None
    """How often each kind of clips comes, such as {text: 2, audio: 1, text+audio: 1}; as the data have them
    where this is null."""
    homogeneous: bool = False
    """Every batch of one kind of clips, in place of mixed ones."""
    drop: Drop = Field(default_factory=dict)
    """How often a clip with several modalities comes without some, such as {text: 0.2, audio: 0.2}."""

    @field_validator("modalities")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in names if name not in MODALITIES]
        if unknown:
            raise ValueError(f"no modality '{unknown[0]}'; known: {', '.join(MODALITIES)}")
        return names


class UttInputs(Inputs):
    """Inputs beside the stages of its modalities."""

    data: Data
    stats: FeatureStats
    tokenizer: TrainedTokenizer


class UttStage(TrainedStage[UttStageConfig, UttInputs, ConditionedUtt]):
    """Conditions to motion tokens."""

    name = "utt"
    summary = "conditions to motion tokens"
    trainer = "motionloom.models.utt.module:UttModule"
    config = UttStageConfig
    offers = frozenset({"token_model"})
    inputs = UttInputs
    curves = tuple(
        Curve(name)
        for name in ("tokens_ce", "tokens_accuracy", "tokens_adversarial", "critic_loss", "critic_accuracy")
    )

    def roles(self) -> tuple[Role | Every, ...]:
        return (*super().roles(), *(Role(name, True, name) for name in MODALITIES))

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Each modality needs the stage that prepares it."""
        for name in stage.config.modalities:
            if name not in stage.inputs:
                raise UserError(
                    f"stage '{stage.name}' is conditioned on {name} and the recipe has no stage '{name}'; "
                    f"add one ({name}: {{kind: {name}}}) or leave it out of modalities"
                )

    def facts(self, config: UttStageConfig, inputs: UttInputs) -> ModelFacts:
        tokenizer = inputs.tokenizer.net
        extra = {
            "mate": config.mate.dump(),
            "widths": {name: inputs[name].dim for name in config.modalities},
            "timed": [name for name in config.modalities if MODALITIES[name].timed],
            **stream_facts(tokenizer),
            "max_frames": config.max_frames,
        }
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: UttInputs) -> ConditionedUtt:
        tokenizer = inputs.tokenizer.net
        require_streams(facts, tokenizer, "token model")
        mate = MateConfig.parse(facts.fact("mate", dict), facts.where)
        config = UttConfig.parse(facts.config, facts.where)
        widths = facts.fact("widths", dict)
        timed = facts.fact("timed", list)
        return ConditionedUtt(mate, config, widths, tokenizer.streams, tokenizer.pattern, timed=timed)

    def module_settings(
        self, config: UttStageConfig, net: ConditionedUtt, inputs: UttInputs
    ) -> dict[str, object]:
        groups = config.max_frames // GROUP_FRAMES
        if groups > net.utt.max_groups:
            raise UserError(
                f"net.block_size {config.net.block_size} holds {net.utt.max_groups} groups of tokens and "
                f"max_frames {config.max_frames} has {groups}; raise net.block_size, or set max_frames to "
                f"{net.utt.max_groups * GROUP_FRAMES}"
            )
        return {"tokenizer": inputs.tokenizer.net}

    def dry_module(self, config: UttStageConfig, net: ConditionedUtt, inputs: UttInputs) -> StageModule:
        """With the adversarial term from the first step on."""
        loss = config.loss.model_copy(update={"adversarial_start": 0, "adversarial_ramp": 0})
        return self.module(config.model_copy(update={"loss": loss}), net, inputs, seed=0)

    def batches(
        self, config: UttStageConfig, net: ConditionedUtt, inputs: UttInputs, seed: int, log: Log
    ) -> Batches:
        readers = {name: MODALITIES[name].reader(inputs[name]) for name in config.modalities}
        frames: dict[str, Any] = {"max_frames": config.max_frames, "min_frames": config.min_frames}
        return clip_batches(
            inputs.data, inputs.stats, readers, seed, clips={"columns": inputs.tokenizer.columns, **frames},
            balance=config.balance, drop=config.drop, homogeneous=config.homogeneous,
        )  # fmt: skip

    def example(self, config: UttStageConfig, net: ConditionedUtt, inputs: UttInputs, batch: int) -> Example:
        tokenizer = inputs.tokenizer.net
        groups = config.max_frames // GROUP_FRAMES
        conditions = {
            name: MODALITIES[name].example(batch, config.max_frames, inputs[name].dim)
            for name in config.modalities
        }
        parts = " + ".join(f"{groups * s.per_group} {s.name}" for s in tokenizer.streams)
        closed = torch.ones(batch, dtype=torch.bool)
        example = motion_example(
            batch, config.max_frames, tokenizer.dim, closed=closed, conditions=conditions
        )
        return Example(example, f"{parts} + {len(net.utt.names)} End for {config.max_frames} frames")

    def loaded(
        self, net: ConditionedUtt, facts: ModelFacts, inputs: UttInputs
    ) -> LoadedWindowed[ConditionedUtt]:
        return LoadedWindowed(net, facts.fact("max_frames", int), inputs)

    def exported(self, config: UttStageConfig) -> tuple[str, ...]:
        return ("tokenizer", *config.modalities)


register(UttStage())
