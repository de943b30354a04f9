"""`BatchPlan`: which items every global batch holds, as a pure function of (seed, batch number).

The order never depends on the number of ranks or loader workers, so a run may stop on two ranks and go on
with one and still see the same global batches; a loader's whole state is the number of batches consumed.
Every rank gets the same number of batches by construction.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.randomness import permutation

POOL = 8
"""Batches sorted by length together. More leave less padding, fewer mix lengths better."""


class BatchPlan:
    """Seeded epochs over `num_items`, cut into global batches of `batch_items`.

    Each epoch is a fresh permutation of all items; a batch never crosses an epoch boundary, so up to
    `batch_items - 1` items (different ones each epoch) sit an epoch out. With fewer items than one batch, the
    permutation repeats until the batch is full.

    With `lengths` [num_items] a batch holds items of similar length, so that little of it is padding: every
    `POOL` batches of the permutation are sorted by length and dealt out again in random order.
    """

    def __init__(
        self, num_items: int, batch_items: int, seed: int, lengths: NDArray[np.int64] | None = None
    ) -> None:
        if num_items < 1:
            raise UserError("the batch plan has no items: the split is empty or every clip was filtered out")
        if batch_items < 1:
            raise UserError(f"a batch needs at least one item, not {batch_items}")
        self.num_items = num_items
        self.batch_items = batch_items
        self.seed = seed
        self.lengths = lengths
        self._order = lru_cache(maxsize=2)(self._permutation)

    @property
    def batches_per_epoch(self) -> int:
        """Global batches in one epoch, at least 1."""
        return max(1, self.num_items // self.batch_items)

    def batch(self, k: int) -> tuple[int, NDArray[np.int64]]:
        """(epoch, item numbers [batch_items]) of global batch `k`, `k >= 0`."""
        if k < 0:
            raise IndexError(f"batch numbers start at 0, not {k}")
        epoch, position = divmod(k, self.batches_per_epoch)
        order = self._order(epoch)
        if self.num_items < self.batch_items:
            return epoch, np.resize(order, self.batch_items)
        start = position * self.batch_items
        return epoch, order[start : start + self.batch_items]

    def local(self, k: int, rank: int, world: int) -> tuple[int, NDArray[np.int64]]:
        """(epoch, item numbers [batch_items / world]): the rank's part of batch `k`.

        Parts are contiguous: rows gathered in rank order stand as in the batch of a single process.
        """
        if self.batch_items % world:
            raise UserError(
                f"a global batch of {self.batch_items} clips does not divide over {world} ranks; "
                f"make the batch size a multiple of the number of ranks"
            )
        epoch, items = self.batch(k)
        share = self.batch_items // world
        return epoch, items[rank * share : (rank + 1) * share]

    def _permutation(self, epoch: int) -> NDArray[np.int64]:
        order = permutation(self.num_items, self.seed, epoch)
        if self.lengths is None or self.num_items < self.batch_items:
            return order
        size, used = self.batch_items, self.batches_per_epoch * self.batch_items
        for start in range(0, used, POOL * size):
            end = min(start + POOL * size, used)
            pool = order[start:end]
            batches = pool[np.argsort(self.lengths[pool], kind="stable")].reshape(-1, size)
            # The epoch's own number keeps this draw apart from that of the permutation itself.
            order[start:end] = batches[permutation(len(batches), self.seed, epoch, start + 1)].ravel()
        return order

    def __getstate__(self) -> dict[str, Any]:
        names = ("num_items", "batch_items", "seed", "lengths")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        BatchPlan.__init__(self, **state)
