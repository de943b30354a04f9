"""A training that branches off another one: it goes on from a checkpoint of it with other settings.

Lightning restores optimizers with the rates, betas and decays they were saved with. In a branch those of its
own config hold from its first step on; moments, step counts and everything else are the checkpoint's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.store.checkpoints import DamagedError, read_checkpoint


class OwnSettings(Callback):
    """Puts the optimizer settings of this training's config over those of the checkpoint it goes on from."""

    def __init__(self) -> None:
        self._groups: list[list[dict[str, Any]]] = []
        self._rates: list[list[Any]] = []

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Note them while the optimizers are new."""
        self._groups = [
            [{name: value for name, value in group.items() if name != "params"} for group in one.param_groups]
            for one in trainer.optimizers
        ]
        self._rates = [list(config.scheduler.base_lrs) for config in trainer.lr_scheduler_configs]

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """The checkpoint is loaded."""
        for optimizer, groups in zip(trainer.optimizers, self._groups, strict=True):
            for group, own in zip(optimizer.param_groups, groups, strict=True):
                group.update(own)
        for config, rates in zip(trainer.lr_scheduler_configs, self._rates, strict=True):
            schedule: Any = config.scheduler
            schedule.base_lrs = list(rates)
            factors = [own(schedule.last_epoch) for own in schedule.lr_lambdas]
            for group, rate, factor in zip(schedule.optimizer.param_groups, rates, factors, strict=True):
                group["lr"] = rate * factor
            schedule._last_lr = [group["lr"] for group in schedule.optimizer.param_groups]


def require_branch(name: str, step: int, steps: int, checkpoint: Path | None, module: StageModule) -> None:
    """Refuse a branch that has nothing to begin with, or another network than the checkpoint's."""
    if checkpoint is None:
        raise UserError(
            f"stage {name} branches off at step {step} (train.branch) and no checkpoint of that training is "
            f"here; name it: --only {name} --from-checkpoint STEP"
        )
    if step >= steps:
        raise UserError(
            f"stage {name} branches off at step {step}, and train.steps is {steps}: raise it above {step}"
        )
    try:
        content = read_checkpoint(checkpoint)
    except DamagedError as error:
        raise UserError(f"{checkpoint}: {error}; branch off from another checkpoint") from None
    found = difference(content["state_dict"], module.state_dict())
    if found:
        raise UserError(
            f"{checkpoint}: the checkpoint is of another network than stage {name} has now: {found}; keep "
            f"the settings of its network, and change those of its training alone (optim, train, losses)"
        )


def difference(there: Mapping[str, Any], here: Mapping[str, Tensor]) -> str:
    """The first parameter or buffer in which two networks differ, in words; nothing where none does."""
    for name in [*there, *(name for name in here if name not in there)]:
        one, other = there.get(name), here.get(name)
        if one is None or other is None:
            whose = "only here" if one is None else "only in the checkpoint"
            return f"{name} is {whose}"
        if one.shape != other.shape:
            return f"{name} is {_shape(one.shape)} in the checkpoint and {_shape(other.shape)} here"
    return ""


def _shape(shape: Sequence[int]) -> str:
    return "[" + ", ".join(map(str, shape)) + "]"
