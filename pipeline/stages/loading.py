"""Batches of a training: one reader whose item k is the batch of micro-step k, in Lightning's chunks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sized
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, cast

import lightning as L
from torch.utils.data import DataLoader, Dataset

from motionloom.pipeline.flight.waits import Waits
from motionloom.pipeline.launch.ending import end_with_parent
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.interruption import unsignalled
from motionloom.pipeline.stages.train_config import BatchSource, EvalSource, TrainConfig


class ChunkLoader:
    """What Lightning takes for a loader of one chunk; the reader behind it goes on from chunk to chunk.

    Workers so read on over the border of a chunk, through checkpoints and validations.
    """

    def __init__(
        self,
        read: Callable[[int], Iterator[Any]],
        position: Callable[[], int],
        size: int,
        waits: Waits,
    ) -> None:
        self.read, self.position, self.size, self.waits = read, position, size, waits
        self._reader: Iterator[Any] | None = None
        self._next = -1

    def __len__(self) -> int:
        """Batches of a whole chunk."""
        return self.size

    def __iter__(self) -> Iterator[Any]:
        """The batches from the training's position to the end of the chunk it lies in."""
        first = self.position()
        if self._reader is None or first != self._next:
            self._reader, self._next = self.read(first), first
        for _ in range(self.size - first % self.size):
            with self.waits.for_data():
                batch = next(self._reader)
            self._next += 1
            yield batch

    def close(self) -> None:
        """Let the reader's workers go."""
        self._reader, self._next = None, -1


class CuttableLoader:
    """A loader of a validation that `cuts(batches done, all batches)` ends early."""

    def __init__(self, loader: DataLoader[Any], cuts: Callable[[int, int], bool]) -> None:
        self.loader, self.cuts = loader, cuts

    def __len__(self) -> int:
        """Batches of a whole validation."""
        return len(self.loader)

    def __iter__(self) -> Iterator[Any]:
        """The batches; it asks when the next one is wanted."""
        count = len(self)
        for done, batch in enumerate(self.loader, start=1):
            yield batch
            if self.cuts(done, count):
                return


class TrainingData(L.LightningDataModule):
    """The loaders of one training; `cuts` ends a validation early (`CuttableLoader`)."""

    def __init__(
        self,
        train: BatchSource,
        validation: EvalSource | None,
        config: TrainConfig,
        chunk: int,
        hardware: Hardware,
        waits: Waits,
        cuts: Callable[[int, int], bool],
    ) -> None:
        super().__init__()
        self.train, self.validation, self.cuts = train, validation, cuts
        self.config, self.chunk, self.hardware, self.waits = config, chunk, hardware, waits
        self._chunks: ChunkLoader | None = None

    def train_dataloader(self) -> ChunkLoader:
        """All batches from where the training goes on to its end."""
        trainer, parts = cast(L.Trainer, self.trainer), self.config.accumulate
        micro = self.config.batch_size // parts
        dataset = self.train(micro, trainer.global_rank, trainer.world_size)
        last = self.config.steps * parts

        def read(first: int) -> Iterator[Any]:
            return iter(_loader(dataset, range(first, last), self.hardware))

        self._chunks = ChunkLoader(read, lambda: trainer.global_step * parts, self.chunk * parts, self.waits)
        return self._chunks

    def val_dataloader(self) -> CuttableLoader | list[Any]:
        """All batches of the held-out data."""
        if self.validation is None:
            return []
        dataset = self.validation()
        return CuttableLoader(_loader(dataset, range(len(cast(Sized, dataset))), self.hardware), self.cuts)

    def close(self) -> None:
        """Let the workers go."""
        if self._chunks is not None:
            self._chunks.close()


class _Loader(DataLoader[Any]):
    def __iter__(self) -> Any:
        if self.num_workers:
            # Started with the first process of all, it would let SIGTERM through to that one.
            resource_tracker.ensure_running()
        with unsignalled():
            return super().__iter__()


def _loader(dataset: Dataset[Any], numbers: range, hardware: Hardware) -> DataLoader[Any]:
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
