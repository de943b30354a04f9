"""What looks on while a training steps, such as the flight recorder; it changes nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor, nn


class Watcher(Protocol):
    """Called by a `StageModule` in every step, with tensors on its device: reading one waits for it."""

    def figures(self, names: tuple[str, ...], values: Tensor) -> None:
        """The losses and metrics of one part of a step, float32 [len(names)], before its backward pass."""
        ...

    def gradients(self, params: Sequence[nn.Parameter], norm: Tensor | None) -> None:
        """The gradients that an optimizer is about to step with are complete, and not clipped yet.

        `norm` is that of all of them, where it was computed.
        """
        ...
