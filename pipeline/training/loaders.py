"""Data loaders of a training, and their batches on its device.

A worker sends a batch as one piece of shared memory: torch opens a file, a socket and a mapping for every
tensor, .7 ms each. On a GPU it writes into the same pieces over and over, since the first writing to new
pages takes several times as long as the copy.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker

import torch
from lightning.fabric import Fabric
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.data import DataLoader, IterableDataset

from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.steps import Steps
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import Batch
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import end_with_parent
from motionloom.pipeline.training.config import BatchSource, EvalSource, TrainConfig
from motionloom.pipeline.training.preemption import signals_blocked

ROOMS = 3
"""Pieces of memory of a worker. A loader that pins asks it for the second batch behind one, torch's
`prefetch_factor`, when that one is pinned; until then it may be read."""


class TrainingData:
    """The loaders of one training."""

    def __init__(
        self, train: BatchSource, validation: EvalSource | None, config: TrainConfig, hardware: Hardware
    ) -> None:
        self.config, self.hardware = config, hardware
        self.train = train(config.batch_size, Share(rank(), world_size(), config.accumulate))
        self.validation = validation
        self._training: _Loader | None = None
        self._held_out: _Loader | None = None

    def batches(self, step: int) -> DataLoader[Batch]:
        """All micro-batches from those of step `step` (from 0) to the end of the training."""
        parts = self.config.accumulate
        steps = Steps(lambda _, __: self.train, self.config.steps * parts, step * parts)
        self._training = loader(steps, self.hardware)
        return self._training

    def held_out(self) -> DataLoader[Batch]:
        """All validation batches; workers stay from one validation to the next."""
        if self._held_out is None:
            assert self.validation is not None
            self._held_out = loader(every_batch(self.validation), self.hardware)
        return self._held_out

    def close(self) -> None:
        """Stop all workers, which ignore signals; the process would wait for them."""
        for one in (self._training, self._held_out):
            if one is not None:
                one.close()
        self._training = self._held_out = None


def every_batch(validation: EvalSource) -> Steps[Batch]:
    """All validation batches, in every process."""
    batches = validation()
    return Steps(lambda _, __: batches, len(batches))


@dataclass(frozen=True)
class Place:
    """Where a tensor lies in a piece of memory; `offset` is in bytes."""

    offset: int
    shape: tuple[int, ...]
    dtype: torch.dtype

    def within(self, memory: Tensor) -> Tensor:
        end = self.offset + math.prod(self.shape) * self.dtype.itemsize
        return memory[self.offset : end].view(self.dtype).view(self.shape)


@dataclass(frozen=True)
class Packed:
    """A batch whose tensors lie in `memory`, uint8 [bytes]; `batch` has places for them."""

    memory: Tensor
    batch: Batch

    def pin_memory(self) -> Packed:
        """Return a copy in pinned memory; the loader's thread calls it."""
        return Packed(self.memory.pin_memory(), self.batch)

    def unpacked(self) -> Batch:
        """Return the batch as it was packed: views of the memory."""
        opened: Batch = tree_map(
            lambda value: value.within(self.memory) if isinstance(value, Place) else value, self.batch
        )
        return opened


class SharedBatches(IterableDataset[Packed]):
    """The batches of `steps`, which a worker puts into shared memory: into `rooms` pieces in turn, so that a
    batch is written over by a later one, or with 0 into a new piece each.
    """

    def __init__(self, steps: Steps[Batch], rooms: int) -> None:
        self.steps, self.rooms = steps, rooms

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[Packed]:
        rooms = [torch.empty(0, dtype=torch.uint8)] * max(1, self.rooms)
        for batch, at in zip(self.steps, itertools.cycle(range(len(rooms))), strict=False):
            end = 0

            def placed(value: object) -> object:
                nonlocal end
                if not isinstance(value, Tensor):
                    return value
                place = Place(end, tuple(value.shape), value.dtype)
                end += -(-value.nbytes // 64) * 64  # numbers of every type begin where they may
                return place

            places = tree_map(placed, batch)
            if not self.rooms or len(rooms[at]) < end:
                # A full /dev/shm is an error here, which ends the training. The thread that sends batches
                # would print it, and the training would wait for ever.
                storage = torch.UntypedStorage._new_shared(end)  # type: ignore[no-untyped-call]
                rooms[at] = torch.empty(0, dtype=torch.uint8).set_(storage)
            for place, value in zip(tree_leaves(places), tree_leaves(batch), strict=True):
                if isinstance(place, Place):
                    place.within(rooms[at]).copy_(value)
            yield Packed(rooms[at][:end], places)


class _Loader(DataLoader[Batch]):
    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        if not self.num_workers:
            return super().__iter__()
        # Started with the first process of all, it would let SIGTERM through to that one.
        resource_tracker.ensure_running()
        with signals_blocked():
            return map(Packed.unpacked, super().__iter__())

    def close(self) -> None:
        """End the workers now; without this they end with the last reference to their iterator.

        An error that came from a worker holds its own traceback, and so the iterator, in a circle.
        """
        if self._iterator is not None:
            self._iterator._shutdown_workers()  # type: ignore[attr-defined]
            self._iterator = None


def loader(steps: Steps[Batch], hardware: Hardware, *, once: bool = False) -> _Loader:
    """Return a loader of ready batches; with `once` no worker is kept for the next epoch."""
    first, last = steps.span()
    workers = hardware.workers_for(last - first)
    kept = workers > 0 and not once  # from validation to validation; their start takes seconds
    # torch pins nothing where it finds no GPU, whatever was asked for.
    pinned = hardware.resolved_accelerator() == "gpu" and torch.accelerator.is_available()
    return _Loader(
        SharedBatches(steps, ROOMS if pinned else 0) if workers else steps,  # type: ignore[arg-type]
        batch_size=None,
        num_workers=workers,
        pin_memory=pinned,
        persistent_workers=kept,
        multiprocessing_context="spawn" if workers else None,
        worker_init_fn=partial(end_with_parent, os.getpid()) if workers else None,
    )


def on_device(batches: Iterable[Batch], fabric: Fabric) -> Iterator[Batch]:
    """Yield the batches on the device of `fabric`; on a GPU the next one is copied by a stream of its own."""
    if fabric.device.type != "cuda":
        yield from map(fabric.to_device, batches)
        return
    copies = torch.cuda.Stream(fabric.device)  # type: ignore[no-untyped-call]

    def copied(batch: Batch) -> tuple[Batch, torch.cuda.Event]:
        with torch.cuda.stream(copies):
            return fabric.to_device(batch), copies.record_event()

    coming = map(copied, batches)
    ahead = next(coming, None)
    while ahead is not None:
        batch, done = ahead
        ahead = next(coming, None)  # on its way before this one's work is queued
        computing = torch.cuda.current_stream(fabric.device)
        computing.wait_event(done)
        for value in tree_leaves(batch):
            if isinstance(value, Tensor):  # the copying stream must not have its memory back while it is read
                value.record_stream(computing)
        yield batch
