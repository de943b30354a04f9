"""UTT stage: MATE and the token transformer, end to end against a discriminator (UDE sections 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch
from pydantic import Field
from torch import nn
from torch.utils.data import Dataset

from motionloom.datasets.conditions import Condition
from motionloom.datasets.loading.condition_batches import ConditionBatches, EvalConditionBatches
from motionloom.datasets.loading.modalities import Balance, Drop
from motionloom.datasets.schema import UserError
from motionloom.models.condition.mate import MateConfig
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.training.optim import OptimConfig
from motionloom.models.utt.conditioned import ConditionedUtt
from motionloom.models.utt.losses import UttLossConfig
from motionloom.models.utt.network import UttConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import Given, Stage
from motionloom.pipeline.stages.examples import text_example
from motionloom.pipeline.stages.streams import require_streams, stream_facts
from motionloom.pipeline.stages.train_config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.stages.trained import Batches, Example, Say, TrainedStage
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts

if TYPE_CHECKING:
    from motionloom.models.utt.module import UttModule

ModalityName = Literal["text", "audio"]


class UttStageConfig(TrainedStageConfig):
    """MATE and UTT."""

    net: UttConfig = UttConfig()
    mate: MateConfig = MateConfig()
    loss: UttLossConfig = UttLossConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam")
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=64)
    modalities: tuple[ModalityName, ...] = ("text", "audio")
    """What the model can be conditioned on; each needs its stage (`text`, `audio`)."""
    max_frames: int = Field(160, ge=8, multiple_of=4)
    """Longest window of a clip."""
    min_frames: int = Field(16, ge=4)
    """Shorter clips are left out."""
    balance: Balance | None = None
    """How often clips with text, music, both or neither come; as the data have them where this is null."""
    homogeneous: bool = False
    """Every batch of one kind of clips, in place of mixed ones."""
    drop: Drop = Drop()
    """How often a clip with both text and music comes with one of them."""


@dataclass(frozen=True)
class LoadedUtt:
    """A trained token model."""

    net: ConditionedUtt
    max_frames: int
    """Frames of a training window."""
    given: Mapping[str, Any]
    """What its stage was given: "tokenizer", and "text" and "audio" as its modalities are."""

    @property
    def modalities(self) -> frozenset[str]:
        """What it can be conditioned on."""
        return frozenset(self.net.mate.widths)


class UttStage(TrainedStage):
    """Conditions to motion tokens."""

    name = "utt"
    summary = "conditions to motion tokens"
    config = UttStageConfig
    takes = ("data", "stats", "tokenizer", "text?", "audio?")

    def gives(self, config: Any) -> frozenset[str]:
        """Tokens of conditions."""
        return super().gives(config) | {"token_model"}

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Each modality needs the stage that prepares it."""
        for name in stage.config.modalities:
            if name not in stage.inputs:
                raise UserError(
                    f"stage '{stage.name}' is conditioned on {name} and the recipe has no stage '{name}'; "
                    f"add one ({name}: {{kind: {name}}}) or leave it out of modalities"
                )

    def facts(self, config: UttStageConfig, given: Given) -> ModelFacts:
        """Both configs, the widths of the modalities and the tokenizer's streams."""
        tokenizer = given["tokenizer"].net
        extra = {
            "mate": config.mate.dump(),
            "widths": {name: given[name].dim for name in config.modalities},
            **stream_facts(tokenizer),
            "max_frames": config.max_frames,
        }
        layout = LayoutFacts.of(given["data"].layout)
        return ModelFacts(kind="utt", config=config.net.dump(), layout=layout, extra=extra)

    def network(self, facts: ModelFacts, given: Given) -> ConditionedUtt:
        """MATE and UTT over the tokenizer's streams, which must be those they were made for."""
        tokenizer = given["tokenizer"].net
        require_streams(facts, tokenizer, "token model")
        mate = MateConfig.parse(facts.fact("mate", dict), facts.where)
        config = UttConfig.parse(facts.config, facts.where)
        widths = facts.fact("widths", dict)
        return ConditionedUtt(mate, config, widths, tokenizer.streams, tokenizer.pattern)

    def module(self, config: UttStageConfig, net: Any, given: Given, seed: int) -> UttModule:
        """Cross-entropy, and what the discriminator says of the decoded motion."""
        from motionloom.models.utt.module import UttModule

        groups = config.max_frames // GROUP_FRAMES
        if groups > net.utt.max_groups:
            raise UserError(
                f"net.block_size {config.net.block_size} holds {net.utt.max_groups} groups of tokens and "
                f"max_frames {config.max_frames} has {groups}; raise net.block_size, or set max_frames to "
                f"{net.utt.max_groups * GROUP_FRAMES}"
            )
        return UttModule(
            net,
            config.optim,
            seed=seed,
            max_steps=config.train.steps,
            tokenizer=given["tokenizer"].net,
            loss=config.loss,
        )

    def dry_module(self, config: UttStageConfig, net: Any, given: Given) -> UttModule:
        """With the adversarial term from the first step on."""
        loss = config.loss.model_copy(update={"adversarial_start": 0, "adversarial_ramp": 0})
        return self.module(config.model_copy(update={"loss": loss}), net, given, seed=0)

    def batches(self, config: UttStageConfig, net: nn.Module, given: Given, seed: int, say: Say) -> Batches:
        """Windows of clips with their conditions."""
        data, stats = given["data"], given["stats"]
        text = given["text"].cache if "text" in config.modalities else None
        audio = given["audio"] if "audio" in config.modalities else None
        columns = given["tokenizer"].columns
        dataset = data.split("train")
        frames: dict[str, Any] = {"max_frames": config.max_frames, "min_frames": config.min_frames}

        def train(batch: int, rank: int, world: int) -> Dataset[Any]:
            return ConditionBatches(
                dataset,
                stats,
                text,
                audio,
                batch_size=batch,
                balance=config.balance,
                drop=config.drop,
                homogeneous=config.homogeneous,
                seed=seed,
                rank=rank,
                world=world,
                columns=columns,
                **frames,
            )

        def validation() -> Dataset[Any]:
            return EvalConditionBatches(
                data.held_out(), stats, text, audio, batch_size=32, columns=columns, **frames
            )

        return Batches(train, validation)

    def example(self, config: UttStageConfig, net: Any, given: Given, batch: int) -> Example:
        """The longest windows with every modality."""
        tokenizer = given["tokenizer"].net
        groups = config.max_frames // GROUP_FRAMES
        conditions: dict[str, Condition] = {}
        for name in config.modalities:
            width = given[name].dim
            if name == "text":
                conditions[name] = text_example(batch, width)
                continue
            mask = torch.ones(batch, config.max_frames, dtype=torch.bool)
            conditions[name] = Condition(torch.empty(batch, config.max_frames, width), mask)
        parts = " + ".join(f"{groups * s.per_group} {s.name}" for s in tokenizer.streams)
        return Example(
            {
                "motion": torch.empty(batch, config.max_frames, tokenizer.dim),
                "length": torch.full((batch,), config.max_frames),
                "closed": torch.ones(batch, dtype=torch.bool),
                "conditions": conditions,
            },
            f"{parts} + {len(net.utt.names)} End for {config.max_frames} frames",
        )

    def loaded(self, net: ConditionedUtt, facts: ModelFacts, given: Given) -> LoadedUtt:
        """The network and its window."""
        return LoadedUtt(net, facts.fact("max_frames", int), given)

    def exported(self, config: UttStageConfig) -> tuple[str, ...]:
        """What decodes its tokens and prepares its conditions."""
        return ("tokenizer", *config.modalities)

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """Cross-entropy, accuracy and both sides of the adversarial game."""
        names = ("tokens_ce", "tokens_accuracy", "tokens_adversarial", "critic_loss", "critic_accuracy")
        return tuple(Curve(name) for name in names)
