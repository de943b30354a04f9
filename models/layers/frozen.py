"""Trained networks that are used and must not change: `Frozen` for good, `evaluating` for a while."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

from torch import nn

M = TypeVar("M", bound=nn.Module)


class Frozen(Generic[M]):
    """Holds a module out of reach of the module that owns this: not a child, hence not in its `state_dict`,
    its parameters or its `.train()`, and on the device that it was loaded to. The held module is in
    evaluation mode and asks for no gradient; gradients still flow *through* it to its inputs.
    """

    def __init__(self, module: M) -> None:
        self.module = module.eval().requires_grad_(False)


@contextmanager
def evaluating(net: nn.Module) -> Iterator[None]:
    """Inside, `net` is in evaluation mode; afterwards it is as it was."""
    before = net.training
    net.eval()
    try:
        yield
    finally:
        net.train(before)
