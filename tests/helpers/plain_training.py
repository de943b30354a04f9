"""A few training steps of a module without a stage around them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.execution import Execution, launch

Precision = Literal["32-true", "bf16-mixed"]


def take_steps(module: StageModule, batches: Sequence[Batch], precision: Precision = "32-true") -> None:
    """One step for every `module.accumulate` batches."""
    config = TrainConfig(accumulate=module.accumulate, precision=precision)
    execution = Execution(launch(Hardware(accelerator="cpu"), config), module, config)
    for first in range(0, len(batches), module.accumulate):
        execution.take_step(batches[first : first + module.accumulate])
