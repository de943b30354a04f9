"""Exponential moving average of a network's weights, kept beside the weights that are trained.

The average begins with the weights after the first step. After n further steps the decay is the smaller of
the configured one and (1 + n) / (10 + n), as in TensorFlow and diffusers: otherwise a short training would
save little but its first weights. Validation and the saved model use the average; training does not. Buffers
(codebooks, which are averages already, statistics, tables of columns) are never averaged: they stay those of
the trained network.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

_Tensors = tuple[Tensor, ...] | list[Tensor]


class AveragedWeights(L.Callback):
    """Averages the weights of a stage's network (`train.ema`), under the pipeline's or any other Trainer.

    Validations see the average, a checkpoint holds both, and when the training is over the network has it.
    """

    def __init__(self, decay: float) -> None:
        self.decay = decay
        self.average: AveragedModel | None = None
        self._count = self._step = 0
        self._state: dict[str, Tensor] | None = None
        self._over = False

    def begin(self, net: nn.Module) -> None:
        """Average the weights of `net`, a network on its device, from here on; equal on every rank."""
        self.average = AveragedModel(net, multi_avg_fn=self._take_in)
        self._count = 0
        if self._state is not None:
            self.average.load_state_dict(self._state)
            self._count = int(self._state["n_averaged"])

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        self.begin(module.net)
        self._step = module.step
        self._over = False

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: object) -> None:
        if module.step > self._step and self.average is not None:  # behind the last part of a step
            self._step = module.step
            self.average.update_parameters(module.net)
            self._count += 1

    def on_validation_start(self, trainer: L.Trainer, module: Any) -> None:
        self._swap(module.net)

    def on_validation_end(self, trainer: L.Trainer, module: Any) -> None:
        self._swap(module.net)

    def on_save_checkpoint(self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]) -> None:
        checkpoint["average"] = None if self.average is None else self.average.state_dict()

    def on_load_checkpoint(self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]) -> None:
        self._state = checkpoint.get("average")  # None: it begins now, with these weights

    def on_fit_end(self, trainer: L.Trainer, module: Any) -> None:
        self._over = True

    def teardown(self, trainer: L.Trainer, module: Any, stage: str) -> None:
        if self._over:
            self.fill(module.net)

    @contextmanager
    def swapped(self, net: nn.Module) -> Iterator[None]:
        """Context in which `net` has the averaged weights."""
        self._swap(net)
        try:
            yield
        finally:
            self._swap(net)

    @torch.no_grad()
    def fill(self, net: nn.Module, state: dict[str, Tensor] | None = None) -> None:
        """Give `net` the averaged weights, those of a checkpoint where `state` is its "average"."""
        if state is not None:
            self._state = state
        if self.average is None or state is not None:
            self.begin(net)
        for param, mean in self._pairs(net):
            param.copy_(mean)

    @torch.no_grad()
    def _swap(self, net: nn.Module) -> None:
        for param, mean in self._pairs(net):
            trained = param.clone()
            param.copy_(mean)
            mean.copy_(trained)

    def _pairs(self, net: nn.Module) -> Iterator[tuple[nn.Parameter, nn.Parameter]]:
        """Yield each weight and its average; nothing where none has begun."""
        if self.average is not None:
            yield from zip(net.parameters(), self.average.module.parameters(), strict=True)

    def _take_in(self, average: _Tensors, weights: _Tensors, _: Tensor | int) -> None:
        """Move the average towards the weights, without waiting for the device."""
        decay = min(self.decay, (1 + self._count) / (10 + self._count))
        get_ema_multi_avg_fn(decay)(average, weights, None)  # type: ignore[no-untyped-call]
