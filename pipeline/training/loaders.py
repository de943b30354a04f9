"""Data loaders of a training under any Trainer, and their batches on its device.

A worker sends a batch as one piece of shared memory: torch opens a file, a socket and a mapping for every
tensor, .7 ms each. On a GPU it writes into the same pieces over and over, since the first writing to new
pages takes several times as long as the copy.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from multiprocessing import resource_tracker
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities import move_data_to_device
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torch.utils.data import DataLoader

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.shared import Packed, SharedBatches
from motionloom.datasets.loading.steps import Numbered, Steps
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import end_with_parent
from motionloom.pipeline.training.config import Batches, EvalSource, TrainConfig
from motionloom.pipeline.training.execution import set_threads
from motionloom.pipeline.training.preemption import signals_blocked

ROOMS = 3
"""Pieces of memory of a worker. A loader that pins asks it for the second batch behind one, torch's
`prefetch_factor`, when that one is pinned; until then it may be read."""


class StageData(L.LightningDataModule):
    """The batches of a stage's training, each rank's own, and those of its validation.

    Step k reads the same global batch on any number of processes and in any epoch; a Trainer that resumes
    goes on behind the last step. `train.batch_size` is the global batch. Batches are loaded in workers where
    `hardware.workers` says how many.
    """

    def __init__(self, batches: Batches, train: TrainConfig, hardware: Hardware | None = None) -> None:
        super().__init__()
        self.batches = batches
        self.config = train
        self.hardware = hardware or Hardware()
        self.waiting: Callable[[], AbstractContextManager[object]] = nullcontext
        """Gives a context around each wait for a training batch."""
        self._held_out: Loader | None = None
        self._training: Loader | None = None

    def setup(self, stage: str) -> None:
        """Use as many CPU threads as `motionloom run`: the number of threads changes rounding."""
        if self.trainer is None:
            return
        set_threads(self.trainer.lightning_module, self.hardware)
        counts: dict[str, object] = {"precision": self.trainer.precision}
        if self.trainer.lightning_module.automatic_optimization:
            counts["accumulate"] = self.trainer.accumulate_grad_batches
        for key, value in counts.items():
            if stage == "fit" and (own := getattr(self.config, key)) != value:
                warnings.warn(f"train.{key} is {own}; what counts is this Trainer's, {value}", stacklevel=2)

    def train_dataloader(self) -> Loader:
        trainer = self.trainer
        module = None if trainer is None else trainer.lightning_module
        parts = module.accumulate if isinstance(module, StageModule) else self.config.accumulate
        steps = self.config.steps if trainer is None or trainer.max_steps < 0 else trainer.max_steps
        size = self.config.batch_size
        batches = self.batches.train

        def make(rank: int, world: int) -> Numbered[Batch]:
            return batches(size, Share(rank, world, parts))

        def done() -> int:
            if trainer is None or getattr(trainer, "overfit_batches", False):  # the same ones over and over
                return 0
            return trainer.global_step * parts

        self._training = Loader(Steps(make, steps * parts, done), self.hardware, self._device(), once=True)
        self._training.waiting = lambda: self.waiting()
        return self._training

    def val_dataloader(self) -> Loader | list[Loader]:
        """Return all validation batches; workers stay from one validation to the next."""
        validation = self.batches.validation
        if validation is None:
            return []
        if self._held_out is None:
            self._held_out = Loader(every_batch(validation), self.hardware, self._device(), once=False)
        return self._held_out

    def teardown(self, stage: str | None = None) -> None:
        """Stop all workers, which ignore signals; the process would wait for them."""
        for one in (self._training, self._held_out):
            if one is not None:
                one.close()
        self._training = self._held_out = None

    def on_exception(self, exception: BaseException) -> None:
        self.teardown()

    def __getstate__(self) -> dict[str, object]:
        raise UserError("strategy ddp_spawn: the batches of a stage cannot be sent; take strategy ddp")

    def _device(self) -> torch.device:
        return torch.device("cpu") if self.trainer is None else self.trainer.strategy.root_device


def every_batch(validation: EvalSource) -> Steps[Batch]:
    """All validation batches, in every process."""
    batches = validation()
    return Steps(lambda _, __: batches, len(batches))


class Loader:
    """The batches of `steps`, ready and on the device: an iterable with a length, as any Trainer takes it.

    Its whole state is the step that the Trainer counts, so there is nothing to save or to restore.
    """

    def __init__(self, steps: Steps[Batch], hardware: Hardware, device: torch.device, *, once: bool) -> None:
        """With `once` no worker is kept for the next epoch, which would begin where this one did."""
        self.steps = steps
        self.hardware = hardware
        self.device = device
        self.once = once
        self.waiting: Callable[[], AbstractContextManager[object]] = nullcontext
        """Gives a context around each wait for a batch."""
        self._opened: DataLoader[Batch] | None = None
        self._packed: Any = None

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches; nothing is read and no worker started before the first is asked for."""
        batches = on_device(self._ready(), self.device)
        while True:
            with self.waiting():
                batch = next(batches, None)
            if batch is None:
                return
            yield batch

    def state_dict(self) -> dict[str, object]:
        return {}

    def load_state_dict(self, state: dict[str, object]) -> None:
        """There is nothing to restore."""

    def close(self) -> None:
        """End the workers now, which ignore signals; without this they end with the last reference to their
        iterator. An error that came from a worker holds its own traceback, and so the iterator, in a circle.
        """
        if self._packed is not None:
            self._packed._shutdown_workers()
            self._packed = None
        self._opened = None

    def _ready(self) -> Iterator[Batch]:
        if self._opened is None:
            self._opened = self._open()
        if not self._opened.num_workers:
            yield from self._opened
            return
        # Started with the first process of all, it would let SIGTERM through to that one.
        resource_tracker.ensure_running()
        with signals_blocked():
            self._packed = iter(self._opened)
        yield from map(Packed.unpacked, self._packed)

    def _open(self) -> DataLoader[Batch]:
        first, last = self.steps.span()
        workers = self.hardware.workers_for(last - first)
        kept = workers > 0 and not self.once  # from validation to validation; their start takes seconds
        # torch pins nothing where it finds no GPU, whatever was asked for.
        pinned = self.hardware.resolved_accelerator() == "gpu" and torch.accelerator.is_available()
        return DataLoader(
            SharedBatches(self.steps, ROOMS if pinned else 0) if workers else self.steps,  # type: ignore[arg-type]
            batch_size=None,
            num_workers=workers,
            pin_memory=pinned,
            persistent_workers=kept,
            multiprocessing_context="spawn" if workers else None,
            worker_init_fn=partial(end_with_parent, os.getpid()) if workers else None,
        )


def on_device(batches: Iterable[Batch], device: torch.device) -> Iterator[Batch]:
    """Yield the batches on the device; on a GPU the next one is copied by a stream of its own."""
    if device.type != "cuda":
        yield from batches  # a CPU has them, and the Trainer copies them to other devices
        return
    copies = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]

    def copied(batch: Batch) -> tuple[Batch, torch.cuda.Event]:
        with torch.cuda.stream(copies):
            return move_data_to_device(batch, device), copies.record_event()

    coming = map(copied, batches)
    ahead = next(coming, None)
    while ahead is not None:
        batch, done = ahead
        ahead = next(coming, None)  # on its way before this one's work is queued
        computing = torch.cuda.current_stream(device)
        computing.wait_event(done)
        for value in tree_leaves(batch):
            if isinstance(value, Tensor):  # the copying stream must not have its memory back while it is read
                value.record_stream(computing)
        yield batch
