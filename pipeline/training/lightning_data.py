"""A stage's module and batches for a `lightning.Trainer`, and modules from checkpoints."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import lightning as L
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.steps import Numbered, Steps
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.contract.stage import CompletedStage, Inputs, StageCache
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.execution import prepare_module, set_threads
from motionloom.pipeline.training.loaders import Loader, every_batch
from motionloom.pipeline.training.trained_stage import Batches, TrainedStage, describe, hyper_parameters


class StageData(L.LightningDataModule):
    """The batches of a stage's training, each rank's own, and those of its validation.

    Step k reads the same global batch on any number of processes and in any epoch; a Trainer that resumes
    goes on behind the last step. `train.batch_size` is the global batch. Batches are loaded in workers where
    `hardware.workers` says how many.
    """

    def __init__(self, batches: Batches, train: TrainConfig, hardware: Hardware | None = None) -> None:
        super().__init__()
        self.batches, self.config, self.hardware = batches, train, hardware or Hardware()
        self.waiting: Callable[[], AbstractContextManager[object]] = nullcontext
        """Gives a context around each wait for a training batch."""
        self._held_out: Loader | None = None
        self._training: Loader | None = None

    def setup(self, stage: str) -> None:
        """Use as many CPU threads as `motionloom run`: the number of threads changes rounding."""
        if self.trainer is None:
            return
        set_threads(self.trainer.lightning_module, self.hardware)
        counts: dict[str, object] = {"precision": self.trainer.precision}
        if self.trainer.lightning_module.automatic_optimization:
            counts["accumulate"] = self.trainer.accumulate_grad_batches
        for key, value in counts.items():
            if stage == "fit" and (own := getattr(self.config, key)) != value:
                warnings.warn(f"train.{key} is {own}; what counts is this Trainer's, {value}", stacklevel=2)

    def train_dataloader(self) -> Loader:
        trainer = self.trainer
        module = None if trainer is None else trainer.lightning_module
        parts = module.accumulate if isinstance(module, StageModule) else self.config.accumulate
        steps = self.config.steps if trainer is None or trainer.max_steps < 0 else trainer.max_steps
        size, batches = self.config.batch_size, self.batches.train

        def make(rank: int, world: int) -> Numbered[Batch]:
            return batches(size, Share(rank, world, parts))

        def done() -> int:
            if trainer is None or getattr(trainer, "overfit_batches", False):  # the same ones over and over
                return 0
            return trainer.global_step * parts

        self._training = Loader(Steps(make, steps * parts, done), self.hardware, self._device(), once=True)
        self._training.waiting = lambda: self.waiting()
        return self._training

    def val_dataloader(self) -> Loader | list[Loader]:
        """Return all validation batches; workers stay from one validation to the next."""
        validation = self.batches.validation
        if validation is None:
            return []
        if self._held_out is None:
            self._held_out = Loader(every_batch(validation), self.hardware, self._device(), once=False)
        return self._held_out

    def teardown(self, stage: str | None = None) -> None:
        """Stop all workers, which ignore signals; the process would wait for them."""
        for one in (self._training, self._held_out):
            if one is not None:
                one.close()
        self._training = self._held_out = None

    def on_exception(self, exception: BaseException) -> None:
        self.teardown()

    def __getstate__(self) -> dict[str, object]:
        raise UserError("strategy ddp_spawn: the batches of a stage cannot be sent; take strategy ddp")

    def _device(self) -> torch.device:
        return torch.device("cpu") if self.trainer is None else self.trainer.strategy.root_device


def open_training(
    kind: TrainedStage[Any, Any, Any],
    config: Any,
    given: Mapping[str, CompletedStage],
    seed: int,
    hardware: Hardware | None = None,
) -> tuple[StageModule, StageData]:
    """Return the module and the batches of a stage's training, untrained; `given` are its inputs by role."""
    module, inputs = _open_module(kind, config, given, seed)
    batches = kind.batches(config, module.net, inputs, seed, lambda _: None)
    module.ema = config.train.ema
    hardware = hardware or Hardware()
    if hardware.workers == "auto":  # each would run a script anew that has no `if __name__ == "__main__"`
        hardware = hardware.model_copy(update={"workers": 0})
    return module, StageData(batches, config.train, hardware)


@torch.random.fork_rng(devices=[])  # a caller's own draws stay what they are
def _open_module(
    kind: TrainedStage[Any, Any, Any], config: Any, given: Mapping[str, CompletedStage], seed: int
) -> tuple[StageModule, Inputs]:
    inputs = kind.inputs.of(StageCache().given(given))
    net, _ = kind.build(config, inputs, seed)
    module = kind.module(config, net, inputs, seed)
    prepare_module(module, config.train)
    module.save_hyperparameters(hyper_parameters(kind.name, config, seed, given, None))
    return module, inputs


def rebuild(content: object, path: object, inputs: Mapping[str, str | Path]) -> StageModule:
    """Return the module that a checkpoint's hyper-parameters describe, with its first weights."""
    return _open_module(*describe(content, path, inputs))[0]
