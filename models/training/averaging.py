"""Exponential moving average of a network's weights, kept beside the weights that are trained.

The average begins with the weights after the first step. Validation and the saved model use it; training
does not. Buffers (codebooks, which are averages already, and statistics) are those of the trained network.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn


class AveragedWeights:
    """Average of the weights of `net`, a network on its device; equal on every rank."""

    def __init__(self, net: nn.Module, decay: float) -> None:
        average = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
        self.average = AveragedModel(net, multi_avg_fn=average)

    def state_dict(self) -> dict[str, Tensor]:
        state: dict[str, Tensor] = self.average.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.average.load_state_dict(state)

    def update(self, net: nn.Module) -> None:
        self.average.update_parameters(net)

    @contextmanager
    def swapped(self, net: nn.Module) -> Iterator[None]:
        """Inside, `net` has the averaged weights."""
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
