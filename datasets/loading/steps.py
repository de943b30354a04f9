"""The batches of a training as an `IterableDataset`, for `lightning.Trainer` and the pipeline's own loop.

Batches are map-style: item `k` is one rank's share of global batch `k` (`batches.py`). `Steps` goes through
the numbers of one training, so no sampler has to be injected, and every rank and worker gets its own share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Protocol, TypeVar

import torch.distributed as dist
from torch.utils.data import IterableDataset, get_worker_info

T_co = TypeVar("T_co", covariant=True)


class Numbered(Protocol[T_co]):
    """Batches by number."""

    def __getitem__(self, k: int, /) -> T_co: ...


class Steps(IterableDataset[T_co]):
    """Batches `first` to `last` (exclusive) of a training; use it with `DataLoader(steps, batch_size=None)`.

    Args:
        make: (rank, world) -> batches of that rank; called on first use, when the process group is there.
        last: Batches of the whole training; `len`, also of one that begins at `first`.
        first: Batches that an earlier process has gone through. Or what counts those that have been trained
            with: each `last` of them are an epoch then, and the next one's numbers go on.
    """

    def __init__(
        self, make: Callable[[int, int], Numbered[T_co]], last: int, first: int | Callable[[], int] = 0
    ) -> None:
        self.make = make
        self.first = first
        self.last = last

    @cached_property
    def batches(self) -> Numbered[T_co]:
        """This rank's batches by number."""
        together = dist.is_available() and dist.is_initialized()
        return self.make(dist.get_rank(), dist.get_world_size()) if together else self.make(0, 1)

    def span(self) -> tuple[int, int]:
        """Numbers of the next batch, and of the one behind the last that there is in this epoch."""
        if isinstance(self.first, int):
            return self.first, self.last
        first = self.first()
        return first, (first // self.last + 1) * self.last

    def __len__(self) -> int:
        return self.last

    def __iter__(self) -> Iterator[T_co]:
        worker = get_worker_info()
        # A loader takes one item of each worker in turn: worker w of n reads every n-th batch from w on.
        begin, stride = (0, 1) if worker is None else (worker.id, worker.num_workers)
        first, last = self.span()
        for k in range(first + begin, last, stride):
            yield self.batches[k]

    def __getstate__(self) -> dict[str, object]:
        """Workers get the rank's batches; they know nothing of the process group."""
        batches = self.batches
        (first, last) = self.span()
        return {"make": None, "first": first, "last": last, "batches": batches}
