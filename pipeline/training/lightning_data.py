"""A stage's module and batches for a `lightning.Trainer`, and modules from checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.stage import CompletedStage, Inputs, StageCache
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.execution import prepare_module
from motionloom.pipeline.training.loaders import StageData
from motionloom.pipeline.training.trained_stage import TrainedStage, describe, hyper_parameters


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
