"""Devices, processes and precision of a training, and its optimizer steps on them."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, cast

import torch
from lightning.fabric import Fabric
from lightning.fabric.plugins.precision import MixedPrecision as FabricMixedPrecision
from lightning.fabric.plugins.precision import Precision
from lightning.fabric.strategies.ddp import DDPStrategy
from lightning.fabric.strategies.model_parallel import ModelParallelStrategy
from lightning.fabric.strategies.strategy import Strategy
from torch import Tensor, nn
from torch.distributed.device_mesh import DeviceMesh

from motionloom.models.layers.transformer import Block, Transformer
from motionloom.models.training.compiled import Compiled
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.team import environment
from motionloom.pipeline.training.config import TrainConfig


def prepare_module(module: StageModule, config: TrainConfig) -> None:
    """Apply the settings of the arithmetic: accumulation and activation checkpoints."""
    module.accumulate = config.accumulate
    for part in module.modules():
        if isinstance(part, Transformer):
            part.checkpointed = config.checkpoint_activations


SMALL = 10_000_000
"""Parameters below which a second thread gains nothing, and loses much where others use the machine
(measured)."""


LAUNCHES = 50_000_000
"""Parameters below which a GPU computes its kernels faster than Python starts them: they are replayed as CUDA
graphs [on an H100 the tokenizer and TMA wait for Python, the GPT of 228 million does not]."""


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


class MixedPrecision(FabricMixedPrecision):
    """Autocast as `lightning.Trainer` has it: batches are not cast, and each use of a weight is cast anew, so
    that gradients add up in float32.
    """

    def forward_context(self) -> AbstractContextManager[object]:
        return torch.autocast(self.device, dtype=self._desired_input_dtype, cache_enabled=False)

    def convert_input(self, data: object) -> object:
        return data

    def convert_output(self, data: object) -> object:
        return data


def launch(hardware: Hardware, config: TrainConfig) -> Fabric:
    """Devices, processes and precision."""
    launcher = environment()
    fabric = Fabric(
        accelerator=hardware.lightning_accelerator(),
        devices=hardware.resolved_devices(),
        num_nodes=hardware.nodes,
        strategy=_strategy(hardware, config),
        plugins=[*([launcher] if launcher else []), precision_of(config.precision, hardware)],
    )
    fabric.launch()
    return fabric


def precision_of(precision: str, hardware: Hardware) -> Precision:
    """The arithmetic of a training."""
    if precision == "32-true":
        return Precision()
    device = "cuda" if hardware.resolved_accelerator() == "gpu" else "cpu"
    return MixedPrecision(cast(Any, precision), device)


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
    """Replace the module's network by a copy that is sharded over the ranks (FSDP2).

    Every transformer block is one unit, gathered when it runs and resharded after it; the rest (embeddings,
    heads) is the last unit. Gradients are averaged over ranks as in DDP, and nothing is gathered in a lower
    precision than it is kept in, so training equals DDP up to the order of sums.
    """
    from torch.distributed.fsdp import fully_shard  # imported where it is used: it takes a second

    assert isinstance(module, StageModule)
    cut = copy.deepcopy(module.net)
    for part in [*(part for part in cut.modules() if isinstance(part, Block)), cut]:
        fully_shard(part, mesh=mesh["data_parallel"])
    module.net = cut
    return module


class Execution:
    """A module on this process's device, wrapped for DDP or FSDP, with its optimizers.

    `take_step` calls the methods of the module that `lightning.Trainer` calls, in its order.
    """

    def __init__(self, fabric: Fabric, module: StageModule, config: TrainConfig) -> None:
        prepare_module(module, config)
        self.fabric, self.module = fabric, module
        cut, on_gpu = isinstance(fabric.strategy, ModelParallelStrategy), fabric.device.type == "cuda"
        if config.compile or (config.compile is None and on_gpu and module.compilable and not cut):
            size = sum(param.numel() for param in module.parameters())
            graphs = on_gpu and size < LAUNCHES and config.accumulate == fabric.world_size == 1
            module.compile_losses(graphs=graphs)
        self.model = fabric.setup_module(module, move_to_device=not cut)  # whole, it may not fit there
        module.to(fabric.device)
        module.on_fit_start()  # frozen networks follow
        self.optimizers = [one["optimizer"] for one in module.configure_optimizers()]

    def take_step(self, parts: Iterable[Batch]) -> Tensor:
        """One training step on the parts of its batch; the loss of the last part."""
        module, fabric = self.module, self.fabric
        automatic, parted = module.automatic_optimization, isinstance(fabric.strategy, DDPStrategy)
        if automatic:
            module.schedule.set_step(module.step)
            self.optimizers[0].zero_grad()
        loss: Tensor | None = None
        for number, batch in enumerate(parts):
            # DDP averages gradients with the last part; groups that take turns average them themselves.
            more = number < module.accumulate - 1 or not automatic
            with fabric.no_backward_sync(self.model, enabled=parted and more):
                loss = self._take_part(batch, number)
        if automatic:
            module.configure_gradient_clipping(self.optimizers[0])
            self.optimizers[0].step()
        module.step += 1
        return torch.zeros(()) if loss is None else loss.detach()

    def _take_part(self, batch: Batch, number: int) -> Tensor | None:
        """Add a part's gradients and return its loss; without CUDA graphs once one has failed."""
        losses = self.module.losses
        if not (isinstance(losses, Compiled) and losses.graphs):
            return self._add_gradients(batch, number)
        restore = self.module.saved_state()
        try:
            return self._add_gradients(batch, number)
        except RuntimeError as error:
            losses.leave(error)
            restore()
            self.optimizers[0].zero_grad()  # graphs are for steps of one part
            return self._add_gradients(batch, number)

    def _add_gradients(self, batch: Batch, number: int) -> Tensor | None:
        with self.fabric.autocast():
            loss: Tensor | None = self.model.training_step(batch, number)
        if self.module.automatic_optimization and loss is not None:
            self.fabric.backward(loss / self.module.accumulate)
        return loss
