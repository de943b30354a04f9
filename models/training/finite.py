"""A loss or a gradient that is not finite ends a training: no checkpoint may hold such a network."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import lightning as L
import torch
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.models.training.distributed import world_size

LOG_EVERY = 10
"""Steps that a row of the log averages."""


class StepFigures(NamedTuple):
    """Losses and metrics of one part of a step, still on the device."""

    step: int
    """Counted from 1, as in the log."""
    names: tuple[str, ...]
    values: Tensor
    """float32 [len(names)]."""


class Recorder(Protocol):
    """What notes the figures of a training: a `StageModule`."""

    figures: list[StepFigures]
    norms: list[tuple[int, Tensor]]


@dataclass(frozen=True)
class Failure:
    """The first step whose loss or gradient was not finite."""

    step: int
    """Counted from 1, as in the log."""
    terms: dict[str, float] = field(default_factory=dict)
    """Figures that were not finite; empty if only the gradient was not."""

    @property
    def order(self) -> float:
        """Sort key: by step, then ranks whose own loss failed before those that got their gradients."""
        return 2.0 * self.step + (not self.terms)

    def describe(self) -> str:
        if not self.terms:
            return f"in step {self.step} the gradient is not finite"
        terms = ", ".join(f"{name} = {value}" for name, value in self.terms.items())
        return f"in step {self.step} the loss is not finite ({terms})"


def first_failure(module: Recorder) -> Failure | None:
    """Return the first failure among the figures of the latest steps, which are cleared."""
    figures = module.figures[:]
    norms = module.norms[:]
    module.figures.clear()
    module.norms.clear()
    failures: list[Failure] = []
    if figures:
        values = torch.cat([part.values for part in figures]).tolist()
        for part in figures:
            own = dict(zip(part.names, values, strict=False))
            values = values[len(part.names) :]
            terms = {name: value for name, value in own.items() if not math.isfinite(value)}
            if any(_is_loss(name) for name in terms):
                failures.append(
                    Failure(part.step, dict(sorted(terms.items(), key=lambda item: _is_loss(item[0]))))
                )
    if norms:
        values = torch.stack([norm.float() for _, norm in norms]).tolist()
        failures += [
            Failure(step) for (step, _), value in zip(norms, values, strict=True) if not math.isfinite(value)
        ]
    return min(failures, key=lambda failure: failure.order, default=None)


def _is_loss(name: str) -> bool:
    """Whether a figure is minimised: a stage's own loss, or an optimizer group's."""
    return name == "loss" or name.endswith("_loss")


def check_is_due(step: int, device: torch.device) -> bool:
    """Whether to look after this step: reading a figure waits for a GPU, and ranks for each other."""
    return (world_size() == 1 and device.type == "cpu") or step % LOG_EVERY == 0


class StopNotFinite(L.Callback):
    """Ends a training with `UserError` where its loss or gradient is not finite."""

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: object) -> None:
        if check_is_due(module.step, module.device):
            self._check(module)

    def on_save_checkpoint(self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]) -> None:
        self._check(module)

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        self._check(module)

    def _check(self, module: Recorder) -> None:
        failure = first_failure(module)
        if failure is not None:
            raise UserError(
                f"{failure.describe()}; look for values in the data that are not finite, or take a lower "
                f"learning rate or a smaller optim.grad_clip"
            )
