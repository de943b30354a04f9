"""Devices, processes and precision of a training: the `lightning.Trainer` of a recipe."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.plugins.io import CheckpointIO
from lightning.pytorch.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler
from lightning.pytorch.strategies import DDPStrategy, ModelParallelStrategy, Strategy
from torch import nn

from motionloom.models.layers.transformer import Transformer
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.team import environment
from motionloom.pipeline.training.config import TrainConfig

PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler}


def prepare_module(module: StageModule, config: TrainConfig) -> None:
    """Apply the settings of the arithmetic: accumulation, activation checkpoints and the residual stream."""
    module.accumulate = config.accumulate
    for part in module.modules():
        if isinstance(part, Transformer):
            part.checkpointed = config.checkpoint_activations
            part.half_residual = config.residual == "bf16"


SMALL = 10_000_000
"""Parameters below which a second thread gains nothing, and loses much where others use the machine
(measured)."""


LAUNCHES = 50_000_000
"""Parameters below which kernels are replayed as CUDA graphs [on an H100 the tokenizer and TMA wait for
Python; of 152 ms of a step of the GPT of 228 million 7 lie between kernels; as graphs it is not timed]."""


def compile_module(module: StageModule, config: TrainConfig, hardware: Hardware) -> None:
    """Compile the losses as `train.compile` says, or where it is known to be worth it."""
    on_gpu = hardware.resolved_accelerator() == "gpu"
    world = hardware.world()
    cut = config.strategy == "fsdp" and world > 1
    if config.compile or (config.compile is None and on_gpu and module.compilable and not cut):
        size = sum(param.numel() for param in module.parameters())
        module.compile_losses(graphs=on_gpu and size < LAUNCHES and config.accumulate == world == 1)


def set_threads(module: nn.Module, hardware: Hardware) -> None:
    """CPU threads of this process, as the recipe says or the network needs."""
    threads = hardware.threads
    if not threads and hardware.resolved_accelerator() == "cpu":
        threads = int(sum(param.numel() for param in module.parameters()) < SMALL)
    if threads:
        torch.set_num_threads(threads)


@contextmanager
def deterministic(hardware: Hardware) -> Iterator[None]:
    """Context in which a GPU uses deterministic kernels alone (`hardware.deterministic`); others raise."""
    if not hardware.deterministic or hardware.resolved_accelerator() == "cpu":
        yield
        return
    # No tensor is read before it is written: filling new ones would only take time.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def make_trainer(
    hardware: Hardware,
    config: TrainConfig,
    module: StageModule,
    callbacks: Sequence[L.Callback],
    checkpoints: CheckpointIO,
    logs: Path,
) -> L.Trainer:
    """Return the Trainer of a recipe's training; validations, checkpoints and logs are its callbacks'."""
    launcher = environment()
    profiler = PROFILERS[config.profiler](dirpath=logs, filename="profile") if config.profiler else None
    trainer = L.Trainer(
        accelerator=hardware.lightning_accelerator(),
        devices=hardware.resolved_devices(),
        num_nodes=hardware.nodes,
        strategy=strategy_of(hardware, config),
        precision=config.precision,
        max_steps=config.steps,
        accumulate_grad_batches=config.accumulate if module.automatic_optimization else 1,
        plugins=[*([launcher] if launcher else []), checkpoints],
        callbacks=list(callbacks),
        profiler=profiler,
        limit_val_batches=0,
        check_val_every_n_epoch=None,  # what looks at validations looks behind each, not at an epoch's end
        val_check_interval=config.steps,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        default_root_dir=logs,  # where Lightning looks for checkpoints of its own: there are none
    )
    # It would tell all ranks of rank 0's SIGTERM before every step, and wait for the GPU each time; they
    # agree on signals of any rank twice a second (`Agreement`).
    trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = _nothing  # type: ignore[method-assign]
    return trainer


def _nothing() -> None:
    pass


def strategy_of(hardware: Hardware, config: TrainConfig) -> str | Strategy:
    """Return the distribution over processes that a recipe asks for."""
    if hardware.world() == 1:
        return "auto"
    if config.strategy == "fsdp":
        return ModelParallelStrategy(
            data_parallel_size=hardware.world(),
            tensor_parallel_size=1,
            save_distributed_checkpoint=False,
            process_group_backend=hardware.backend(),
        )
    return DDPStrategy(
        process_group_backend=hardware.backend(),
        # The quantizers keep codebooks equal themselves; rank 0's copy must not overwrite them mid-step.
        forward_sync_buffers=False,
        # Without it torch orders its buckets anew after the first step of a process, and more than two ranks
        # then add in another order: a resumed training would have other bytes.
        find_unused_parameters=True,
    )
