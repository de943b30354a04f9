"""Base of the stages that train one network.

`facts` and `network` say how the network is built. Training calls them with the outputs of the input stages,
a dry run with previews of these, and loading with the facts that were saved beside the weights.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from os.path import relpath
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar, cast

import torch
from torch import nn

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.models.training.distributed import rank
from motionloom.pipeline.contract.lookup import outside_stage
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.contract.stage import (
    SHOWING,
    CompletedStage,
    Every,
    Inputs,
    Role,
    StageContext,
    StageKind,
    stage_kind,
)
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.store.files import copy_files
from motionloom.pipeline.store.run_folder import identity_of
from motionloom.pipeline.store.weights import (
    MODEL_FILES,
    ModelFacts,
    Release,
    built,
    load_facts,
    load_weights,
    save_model,
)
from motionloom.pipeline.training.config import CALLBACKS, TrainedStageConfig
from motionloom.pipeline.training.config import Batches as Batches

if TYPE_CHECKING:
    from motionloom.models.training.stage_module import Batch, StageModule

Log = Callable[[str], None]
"""Prints one line to the console."""

C = TypeVar("C", bound=TrainedStageConfig)
I = TypeVar("I", bound=Inputs)  # noqa: E741
N = TypeVar("N", bound=nn.Module)


class Example(NamedTuple):
    """A batch of the shapes that training sees, for dry runs."""

    batch: Batch
    note: str = ""
    """Its tokens, in words."""


class TrainedStage(StageKind[C], Generic[C, I, N]):
    """A kind that trains a network of type `N`, by a config `C`, from inputs `I`."""

    config: type[C]
    inputs: type[I] = cast(type[I], Inputs)
    """Declares what the stage takes."""
    trainer: str = ""
    """The `StageModule` that trains the network, as "package.module:Class"; it is imported where a training
    begins, since Lightning takes seconds."""
    trains = True

    def modules(self, config: C) -> Iterable[str]:
        """Modules of its classes, and those that nothing here imports: its trainer's and its callbacks'."""
        called = [CALLBACKS[name].make.__module__ for name in config.train.callbacks]
        return [*super().modules(config), self.trainer.partition(":")[0], *called]

    def roles(self) -> tuple[Role | Every, ...]:
        return self.inputs.roles() or super().roles()

    @abstractmethod
    def facts(self, config: C, inputs: I) -> ModelFacts:
        """Return the facts that build the network, beside the inputs that an export takes along."""

    @abstractmethod
    def network(self, facts: ModelFacts, inputs: I) -> N:
        """The untrained network; `UserError` where it does not fit the inputs."""

    def module(self, config: C, net: N, inputs: I, seed: int) -> StageModule:
        """The network with its losses and optimizers, and all settings that the trainer takes by name."""
        trainer: Callable[..., StageModule] = resolve_name(self.trainer)
        named = type(config).model_fields.keys() & signature(trainer).parameters.keys()
        settings = {key: getattr(config, key) for key in named} | self.module_settings(config, net, inputs)
        return trainer(**settings | {"net": net, "seed": seed, "max_steps": config.train.steps})

    def module_settings(self, config: C, net: N, inputs: I) -> dict[str, object]:
        """Return what the trainer takes besides settings of the config, the network, a seed and the steps."""
        return {}

    @abstractmethod
    def batches(self, config: C, net: N, inputs: I, seed: int, log: Log) -> Batches:
        """Training and validation batches."""

    @abstractmethod
    def example(self, config: C, net: N, inputs: I, batch: int) -> Example:
        """A batch of `batch` rows, as large as training may see."""

    def dry_module(self, config: C, net: N, inputs: I) -> StageModule:
        """The module whose memory a dry run counts."""
        return self.module(config, net, inputs, seed=0)

    def prepare(self, config: C, net: N, inputs: I) -> None:
        """Set statistics and weights that the network takes over from other stages before training."""

    def loaded(self, net: N, facts: ModelFacts, inputs: I) -> object:
        """Return the output for other stages: the trained network, frozen, or an object around it."""
        return net

    def release(self, net: N) -> Release | None:
        """Return the published names of the network's tensors; None if these settings have none."""
        return None

    def gives(self, config: C) -> frozenset[str]:
        return self.offers | {SHOWING}

    def external(self, config: C) -> object:
        """The checksum of published weights."""
        if config.published is None:
            return None
        path = config.published.expanduser()
        if not path.is_file():
            raise UserError(
                f"{path}: no such file (key 'published' of a {self.name} stage); name the weights"
            )
        return {"published": sha256_of(path)}

    def exported_config(self, config: C) -> C:
        """Return the config without the folder of published weights."""
        if config.published is None:
            return config
        return config.model_copy(update={"published": Path(config.published.name)})

    def build(self, config: C, inputs: I, seed: int) -> tuple[N, ModelFacts]:
        """Return the untrained network, prepared from other stages, and its facts."""
        facts = self.facts(config, inputs)
        torch.manual_seed(seed)
        net = self.network(facts, inputs)
        self.prepare(config, net, inputs)
        return net, facts

    def run(self, context: StageContext) -> None:
        from motionloom.pipeline.training.trainer import fit

        config = context.config
        inputs = self.inputs.of(context.given)
        inputs.work = context.units.folder
        seed = config.train.seed_of(context.seed)
        net, facts = self.build(config, inputs, seed)
        log = _printer(context)
        if config.published is not None:
            if rank() == 0:
                self._fill(net, config.published.expanduser())
                log(f"weights of {config.published}; nothing is trained")
                save_model(context.folder, net, facts)
            return
        module = self.module(config, net, inputs, seed)
        hyper = hyper_parameters(self.name, config, seed, context.inputs, context.folder)
        module.save_hyperparameters(hyper)
        batches = self.batches(config, net, inputs, seed, log)
        fit(context, module, config.train, batches.train, batches.validation)
        if rank() == 0:
            save_model(context.folder, net, facts)
            context.units.clear()

    def _fill(self, net: N, path: Path) -> None:
        release = self.release(net)
        if release is None:
            raise UserError(
                f"no published weights are known of such a network of kind {self.name}; leave `published` out"
            )
        release.fill(path, net)

    def preview(self, config: C, given: Inputs) -> object:
        inputs = self.inputs.of(given)
        facts = self.facts(config, inputs)
        return self.loaded(_frozen(self.network(facts, inputs)), facts, inputs)

    def preview_of_finished(self, stage: CompletedStage, given: Inputs) -> object:
        """Return the network of a stage outside the recipe's run, without its weights."""
        facts = load_facts(stage.folder)
        inputs = self.inputs.of(given)
        return self.loaded(_frozen(self.network(facts, inputs)), facts, inputs)

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> Any:
        facts = load_facts(stage.folder)
        inputs = self.inputs.of(given)
        net = built(stage.folder, lambda: self.network(facts, inputs))
        load_weights(stage.folder, net)
        return self.loaded(_frozen(net.to(device)), facts, inputs)

    def export(self, stage: CompletedStage, target: Path) -> None:
        copy_files(stage.folder, target, MODEL_FILES)

    def require_inputs(self, config: C, given: Inputs) -> None:
        """Build the network on tensors without values, which raises where the inputs do not fit."""
        from torch._subclasses.fake_tensor import FakeTensorMode

        with FakeTensorMode(allow_non_fake_inputs=True):
            inputs = self.inputs.of(given)
            self.network(self.facts(config, inputs), inputs)

    def estimate(self, config: C, given: Inputs, hardware: Hardware) -> ModelCard:
        """Parameters and memory of one training process, from the code that will run, on fake tensors."""
        from motionloom.pipeline.training.memory import model_card

        size = config.train.local_batch(hardware.world())

        def dry() -> tuple[StageModule, Batch, str]:
            inputs = self.inputs.of(given)
            net = self.network(self.facts(config, inputs), inputs)
            return self.dry_module(config, net, inputs), *self.example(config, net, inputs, size)

        return model_card(dry, config.train, size, hardware)


def hyper_parameters(
    kind: str, config: TrainedStageConfig, seed: int, given: Mapping[str, CompletedStage], base: Path | None
) -> dict[str, object]:
    """Return what rebuilds a stage's module, as plain values; folders of inputs are as seen from `base`."""
    folders = {role: stage.folder.resolve() for role, stage in given.items()}
    places = {
        role: relpath(folder, base.resolve()) if base else str(folder) for role, folder in folders.items()
    }
    ids = {role: identity_of(stage.folder) for role, stage in given.items()}
    return {"kind": kind, "config": config.dump(), "seed": seed, "inputs": places, "identities": ids}


def describe(
    content: object, path: object, inputs: Mapping[str, str | Path]
) -> tuple[TrainedStage[Any, Any, Any], Any, dict[str, CompletedStage], int]:
    """Return kind, config, inputs and seed of a checkpoint's training; `inputs` overrule its folders."""
    hyper = content.get("hyper_parameters") if isinstance(content, dict) else None
    if not isinstance(hyper, dict) or not {"kind", "config", "seed", "inputs"} <= hyper.keys():
        raise UserError(f"{path}: no hyper-parameters of a stage; build the module and give net= and optim=")
    kind = stage_kind(str(hyper["kind"]), str(path))
    if not isinstance(kind, TrainedStage):
        raise UserError(f"{path}: stages of kind {kind.name} train no network")
    config = kind.config.parse(dict(hyper["config"]), f"{path}: config")
    # Of a run's own checkpoint, RUN/stages/NAME/checkpoints/FILE, folders are given as seen from the stage.
    stage = Path(str(path)).absolute().parent.parent
    given: dict[str, CompletedStage] = {}
    for role, place in {**hyper["inputs"], **inputs}.items():
        found = outside_stage(stage / str(place))
        if found is None:
            raise UserError(
                f'{path}: input {place} is no finished stage; give inputs={{"{role}": its folder}}'
            )
        given[role] = found
    return kind, config, given, int(hyper["seed"])


def _frozen(net: N) -> N:
    return net.eval().requires_grad_(False)


def _printer(context: StageContext) -> Log:
    def log(line: str) -> None:
        context.console.print(f"    {line}")

    return log
