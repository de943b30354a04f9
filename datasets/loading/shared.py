"""Batches in memory that a loader's worker shares with the process that trains.

A worker imports this module and what its batches are made of: torch, but not Lightning, which takes seconds
and 200 MB in each of dozens of workers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.data import IterableDataset

from motionloom.datasets.loading.steps import Steps


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
    batch: Any

    def pin_memory(self) -> Packed:
        """Return a copy in pinned memory; the loader's thread calls it."""
        return Packed(self.memory.pin_memory(), self.batch)

    def unpacked(self) -> Any:
        """Return the batch as it was packed: views of the memory."""
        return tree_map(
            lambda value: value.within(self.memory) if isinstance(value, Place) else value, self.batch
        )


class SharedBatches(IterableDataset[Packed]):
    """The batches of `steps`, which a worker puts into shared memory: into `rooms` pieces in turn, so that a
    batch is written over by a later one, or with 0 into a new piece each.
    """

    def __init__(self, steps: Steps[Any], rooms: int) -> None:
        self.steps = steps
        self.rooms = rooms

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
