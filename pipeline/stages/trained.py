"""A stage that trains one network: the part of the contract that all such kinds share.

The wiring of a network stands once, in `facts` and `network`. Training calls them with what the input stages
left behind, a dry run with previews of it, and loading with the facts that were written beside the weights.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from motionloom.models.training.lora import trained_share
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.contract.stage import SHOWING, Finished, Given, StageContext, StageKind
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.train_config import BatchSource, EvalSource, TrainedStageConfig
from motionloom.pipeline.store.files import copy_files
from motionloom.pipeline.store.weights import MODEL_FILES, ModelFacts, load_facts, load_weights, save_model

if TYPE_CHECKING:
    from motionloom.models.training.stage_module import StageModule

Say = Callable[[str], None]
"""Tells the person at the terminal one line."""


@dataclass(frozen=True)
class Batches:
    """Where a training's batches come from."""

    train: BatchSource
    validation: EvalSource | None


@dataclass(frozen=True)
class Example:
    """A batch of the shapes that training sees, for dry runs."""

    batch: dict[str, Any]
    note: str = ""
    """What its tokens are."""


class TrainedStage(StageKind):
    """A kind that trains a network. `config` is a `TrainedStageConfig`."""

    config: type[TrainedStageConfig]
    trains = True

    @abstractmethod
    def facts(self, config: Any, given: Given) -> ModelFacts:
        """All that building the network needs beside the inputs that an export takes along."""

    @abstractmethod
    def network(self, facts: ModelFacts, given: Given) -> nn.Module:
        """The untrained network; `UserError` where it does not fit what is given."""

    @abstractmethod
    def module(self, config: Any, net: nn.Module, given: Given, seed: int) -> StageModule:
        """The network with its losses and optimizers."""

    @abstractmethod
    def batches(self, config: Any, net: nn.Module, given: Given, seed: int, say: Say) -> Batches:
        """Training and validation batches."""

    @abstractmethod
    def example(self, config: Any, net: nn.Module, given: Given, batch: int) -> Example:
        """A batch of `batch` rows, as large as training may see."""

    def dry_module(self, config: Any, net: nn.Module, given: Given) -> StageModule:
        """The module whose memory a dry run counts."""
        return self.module(config, net, given, seed=0)

    def prepare(self, config: Any, net: Any, given: Given) -> None:
        """Set what the network takes over from other stages before training: statistics, weights."""

    def trained(self, config: Any, net: Any) -> None:
        """Make the trained network, in place, what is saved."""

    def loaded(self, net: Any, facts: ModelFacts, given: Given) -> Any:
        """What other stages get: the trained network, frozen, or an object around it."""
        return net

    def gives(self, config: Any) -> frozenset[str]:
        """Its curves."""
        return frozenset({SHOWING})

    def run(self, context: StageContext) -> None:
        """Train, and write weights and facts."""
        from motionloom.pipeline.stages.training import fit

        config, given = context.config, context.given
        facts = self.facts(config, given)
        seed = context.seed if config.train.seed is None else config.train.seed
        torch.manual_seed(seed)
        net = self.network(facts, given)
        self.prepare(config, net, given)
        module = self.module(config, net, given, seed)
        say = _printer(context)
        batches = self.batches(config, net, given, seed, say)
        part, whole = trained_share(net)
        if part < whole:
            say(f"{part:,} of {whole:,} parameters are trained ({part / whole:.1%})")
        fit(context, module, config.train, batches.train, batches.validation, config.optim.grad_clip)
        if module.global_rank == 0:
            self.trained(config, module.net)
            save_model(context.folder, module.net, facts)

    def preview(self, config: Any, given: Given) -> Any:
        """The untrained network, as `load` will give it trained."""
        facts = self.facts(config, given)
        net = self.network(facts, given)
        return self.loaded(_frozen(net), facts, given)

    def preview_of_finished(self, stage: Finished, given: Given) -> Any:
        """The network of a stage outside the recipe's run, without its weights."""
        facts = load_facts(stage.folder)
        return self.loaded(_frozen(self.network(facts, given)), facts, given)

    def load(self, stage: Finished, given: Given, device: torch.device) -> Any:
        """The trained network on `device`, frozen."""
        facts = load_facts(stage.folder)
        net = self.network(facts, given)
        load_weights(stage.folder, net)
        return self.loaded(_frozen(net.to(device)), facts, given)

    def export(self, stage: Finished, target: Path) -> None:
        """Weights and facts."""
        copy_files(stage.folder, target, MODEL_FILES)

    def estimate(self, config: Any, given: Given, hardware: Hardware) -> ModelCard:
        """Parameters and memory of one training process, from the code that will run, on fake tensors."""
        from motionloom.pipeline.stages.memory import model_card

        size = config.train.local_batch(hardware.world())

        def make() -> tuple[StageModule, Example]:
            net = self.network(self.facts(config, given), given)
            return self.dry_module(config, net, given), self.example(config, net, given, size)

        return model_card(make, config.train, size, hardware)


def _frozen(net: nn.Module) -> nn.Module:
    return net.eval().requires_grad_(False)


def _printer(context: StageContext) -> Say:
    def say(line: str) -> None:
        context.console.print(f"    {line}")

    return say
