"""A few training steps of a module without a stage around them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from lightning.fabric import Fabric

from motionloom.models.training.stage_module import Batch, Execution, StageModule


def take_steps(module: StageModule, batches: Sequence[Batch], half: torch.dtype | None = None) -> None:
    """One step for every `module.accumulate` batches."""
    how = Execution(Fabric(accelerator="cpu", devices=1), module, half)
    optimizers = module.configure_optimizers()
    for first in range(0, len(batches), module.accumulate):
        module.take_step(batches[first : first + module.accumulate], optimizers, how)
