"""Execution of a training: devices, processes and precision, the module on them, and its loaders."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sized
from functools import partial
from multiprocessing import resource_tracker
from typing import cast

import torch
from lightning.fabric import Fabric
from lightning.fabric.strategies.ddp import DDPStrategy
from lightning.fabric.strategies.model_parallel import ModelParallelStrategy
from lightning.fabric.strategies.strategy import Strategy
from torch import nn
from torch.distributed.device_mesh import DeviceMesh
from torch.utils.data import DataLoader, Dataset

from motionloom.models.layers.transformer import Transformer
from motionloom.models.training.alternating import AlternatingModule
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.sharding import sharded
from motionloom.models.training.stage_module import Batch, Execution, StageModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import end_with_parent
from motionloom.pipeline.launch.team import environment
from motionloom.pipeline.training.config import BatchSource, EvalSource, TrainConfig
from motionloom.pipeline.training.preemption import unsignalled


def prepare_module(module: StageModule, config: TrainConfig) -> None:
    """Apply the settings of the arithmetic: fused optimizer, accumulation, activation checkpoints."""
    module.fused = config.precision != "16-mixed"
    module.accumulate = config.accumulate
    for part in module.modules():
        if isinstance(part, Transformer):
            part.checkpointed = config.checkpoint_activations


SMALL = 10_000_000
"""Parameters below which a second thread gains nothing, and loses much where others use the machine
(measured)."""


def set_threads(module: nn.Module, hardware: Hardware) -> None:
    """CPU threads of this process, as the recipe says or the network needs."""
    threads = hardware.threads
    if not threads and hardware.resolved_accelerator() == "cpu":
        threads = int(sum(param.numel() for param in module.parameters()) < SMALL)
    if threads:
        torch.set_num_threads(threads)


def launch(hardware: Hardware, config: TrainConfig) -> Fabric:
    """Devices, processes and precision."""
    launcher = environment()
    fabric = Fabric(
        accelerator=hardware.lightning_accelerator(),
        devices=hardware.resolved_devices(),
        num_nodes=hardware.nodes,
        strategy=_strategy(hardware, config),
        precision=config.precision,
        plugins=[launcher] if launcher else None,
    )
    fabric.launch()
    return fabric


def _strategy(hardware: Hardware, config: TrainConfig) -> str | Strategy:
    if hardware.world() == 1:
        return "auto"
    if config.strategy == "fsdp":
        return ModelParallelStrategy(
            parallelize_fn=_shard,
            data_parallel_size=hardware.world(),
            tensor_parallel_size=1,
            process_group_backend=hardware.backend(),
        )
    return DDPStrategy(
        process_group_backend=hardware.backend(),
        # The quantizers keep codebooks equal themselves; rank 0's copy must not overwrite them mid-step.
        forward_sync_buffers=False,
    )


def _shard(module: nn.Module, mesh: DeviceMesh) -> nn.Module:
    assert isinstance(module, StageModule)
    module.net = sharded(module.net, mesh["data_parallel"])
    return module


def execution(fabric: Fabric, module: StageModule, config: TrainConfig) -> Execution:
    """The module on its device, cut or wrapped as the strategy says; groups average gradients themselves."""
    model: nn.Module = module
    if isinstance(fabric.strategy, ModelParallelStrategy):
        model = fabric.strategy.setup_module(module)
    module.to(fabric.device)
    if isinstance(fabric.strategy, DDPStrategy) and not isinstance(module, AlternatingModule):
        model = fabric.strategy.setup_module(module)
    # bfloat16 has the range of float32, so only float16 comes with a scaler.
    scaler = getattr(fabric.strategy.precision, "scaler", None)
    half = None if config.precision == "32-true" else torch.bfloat16 if scaler is None else torch.float16
    return Execution(fabric, model, half, scaler)


class TrainingData:
    """The loaders of one training."""

    def __init__(
        self, train: BatchSource, validation: EvalSource | None, config: TrainConfig, hardware: Hardware
    ) -> None:
        self.config, self.hardware = config, hardware
        source = train(config.batch_size // config.accumulate, rank(), world_size())
        self.train = cast(Dataset[Batch], source)
        self.validation = validation
        self._held_out: DataLoader[Batch] | None = None

    def batches(self, step: int) -> Iterator[Batch]:
        """All micro-batches from those of step `step` (from 0) to the end of the training."""
        parts = self.config.accumulate
        return iter(_loader(self.train, range(step * parts, self.config.steps * parts), self.hardware))

    def held_out(self) -> DataLoader[Batch]:
        """All validation batches; workers stay from one validation to the next."""
        if self._held_out is None:
            assert self.validation is not None
            dataset = cast(Dataset[Batch], self.validation())
            self._held_out = _loader(dataset, range(len(cast(Sized, dataset))), self.hardware)
        return self._held_out


class _Loader(DataLoader[Batch]):
    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        if self.num_workers:
            # Started with the first process of all, it would let SIGTERM through to that one.
            resource_tracker.ensure_running()
        with unsignalled():
            return super().__iter__()


def _loader(dataset: Dataset[Batch], numbers: range, hardware: Hardware) -> DataLoader[Batch]:
    workers = hardware.workers
    return _Loader(
        dataset,
        batch_size=None,
        sampler=numbers,
        num_workers=workers,
        pin_memory=hardware.resolved_accelerator() == "gpu",
        persistent_workers=workers > 0,  # from validation to validation; their start takes seconds
        multiprocessing_context="spawn" if workers else None,
        worker_init_fn=partial(end_with_parent, os.getpid()) if workers else None,
    )
