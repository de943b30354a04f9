"""Exponential moving average of a network's weights, kept beside the weights that are trained.

The average begins with the weights after the first step. After n further steps the decay is the smaller of
the configured one and (1 + n) / (10 + n), as in TensorFlow and diffusers: otherwise a short training would
save little but its first weights. Validation and the saved model use the average; training does not. Buffers
(codebooks, which are averages already, and statistics) are copied from the trained network.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

_Tensors = tuple[Tensor, ...] | list[Tensor]


class AveragedWeights:
    """Average of the weights of `net`, a network on its device; equal on every rank."""

    def __init__(self, net: nn.Module, decay: float) -> None:
        self.average = AveragedModel(net, multi_avg_fn=self._take_in)
        self.decay, self._count = decay, 0

    def _take_in(self, average: _Tensors, weights: _Tensors, _: Tensor | int) -> None:
        """Move the average towards the weights, without waiting for the device."""
        decay = min(self.decay, (1 + self._count) / (10 + self._count))
        get_ema_multi_avg_fn(decay)(average, weights, None)  # type: ignore[no-untyped-call]

    def state_dict(self) -> dict[str, Tensor]:
        state: dict[str, Tensor] = self.average.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.average.load_state_dict(state)
        self._count = int(state["n_averaged"])

    def update(self, net: nn.Module) -> None:
        self.average.update_parameters(net)
        self._count += 1

    @contextmanager
    def swapped(self, net: nn.Module) -> Iterator[None]:
        """Context in which `net` has the averaged weights."""
        self._swap(net)
        try:
            yield
        finally:
            self._swap(net)

    @torch.no_grad()
    def fill(self, net: nn.Module) -> None:
        for param, mean in zip(net.parameters(), self.average.module.parameters(), strict=True):
            param.copy_(mean)

    @torch.no_grad()
    def _swap(self, net: nn.Module) -> None:
        for param, mean in zip(net.parameters(), self.average.module.parameters(), strict=True):
            trained = param.clone()
            param.copy_(mean)
            mean.copy_(trained)
