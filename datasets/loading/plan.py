"""`BatchPlan`: which items every global batch holds, as a pure function of (seed, batch number).

The order never depends on the number of ranks or loader workers, so a run may stop on two ranks and go on
with one and still see the same global batches; a loader's whole state is the number of batches consumed.
Every rank gets the same number of batches by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.randomness import permutation
from motionloom.datasets.loading.order import mixed_order, shares, source_order, stream_rows, streamed_order
from motionloom.datasets.shards.clips import Source

POOL = 8
"""Batches sorted by length together. More of them mean less padding, fewer mix lengths better."""


class Share(NamedTuple):
    """The rows of a step's batch that one process reads, some of each part."""

    rank: int = 0
    world: int = 1
    """Processes."""
    parts: int = 1
    """Parts that a step's batch is cut into; each is divided over the processes and read by itself."""


ALONE = Share()
"""All of it: of one process, in one part."""


class BatchPlan:
    """Seeded epochs over `num_items`, cut into global batches of `batch_items`.

    Each epoch is a fresh permutation of all items; a batch never crosses an epoch boundary, so up to
    `batch_items - 1` items (different ones each epoch) sit an epoch out. With fewer items than one batch, the
    permutation repeats until the batch is full.

    `sources` say how the items lie. One with shard numbers gives the streamed order (`order.streamed_order`).
    Several are mixed by their weights (`order.mixed_order`): an epoch then is as many places as there are
    items in all sources, rounded down to whole batches, shared out exactly by weight.

    With `lengths` [num_items] a batch holds items of similar length, so that little of it is padding: every
    `POOL` batches of the order are sorted by length and dealt out again in random order, each stream's rows
    by themselves. Shares by weight then hold for such a pool, not for each batch.
    """

    def __init__(
        self,
        num_items: int,
        batch_items: int,
        seed: int,
        lengths: NDArray[np.int64] | None = None,
        sources: Sequence[Source] = (),
    ) -> None:
        if num_items < 1:
            raise UserError("the batch plan has no items: the split is empty or every clip was filtered out")
        if batch_items < 1:
            raise UserError(f"a batch needs at least one item, not {batch_items}")
        self.num_items = num_items
        self.batch_items = batch_items
        self.seed = seed
        self.lengths = lengths
        self.sources = tuple(sources) or (Source(0, num_items),)
        if len(self.sources) > 1:
            shares(self.sources, self._used)  # too small a weight is refused now, not in a loader worker
        self._streams = stream_rows(self.sources[0], batch_items)
        self._order = lru_cache(maxsize=2)(self._epoch)

    @property
    def batches_per_epoch(self) -> int:
        """Global batches in one epoch, at least 1."""
        return max(1, self.num_items // self.batch_items)

    @cached_property
    def ahead(self) -> int:
        """Batches between a shard's first one and that of its stream's next shard; 1 in other orders."""
        source = self.sources[0]
        if source.shards is None or len(self.sources) > 1:
            return 1
        return max(1, source.group * source.count // (len(np.unique(source.shards)) * self.batch_items))

    @property
    def _used(self) -> int:
        return self.batches_per_epoch * self.batch_items

    def batch(self, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(turns, items), both [batch_items], of global batch `k`, `k >= 0`.

        The turn counts how often an item's data set has been gone through before: the epoch, unless data
        sets are mixed. Random draws for an item are keyed by its turn.
        """
        if k < 0:
            raise IndexError(f"batch numbers start at 0, not {k}")
        epoch, position = divmod(k, self.batches_per_epoch)
        order, turns = self._order(epoch)
        if len(order) < self.batch_items:
            return np.resize(turns, self.batch_items), np.resize(order, self.batch_items)
        part = slice(position * self.batch_items, (position + 1) * self.batch_items)
        return turns[part], order[part]

    def local(self, n: int, share: Share) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(turns, items), [batch_items / world / parts]: the share of part `n % parts` of global batch
        `n // parts`.

        Shares are contiguous: rows gathered in the order of parts, then ranks, stand as in the whole batch.
        """
        rank, world, parts = share
        if self.batch_items % (world * parts):
            cut = f" in {parts} parts" * (parts > 1)
            raise UserError(
                f"a global batch of {self.batch_items} clips does not divide over {world} ranks{cut}; "
                f"make the batch size a multiple of {world * parts}"
            )
        turns, items = self.batch(n // parts)
        size = self.batch_items // (world * parts)
        first = (n % parts * world + rank) * size
        return turns[first : first + size], items[first : first + size]

    def _epoch(self, epoch: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        source = self.sources[0]
        if len(self.sources) > 1:
            order, turns = mixed_order(self.sources, self._used, self.seed, epoch)
        else:
            if source.shards is None:
                order = source_order(source, self.seed, epoch)
            else:
                order = streamed_order(source, self.batch_items, self.seed, epoch)
            turns = np.full(len(order), epoch)
        if self.lengths is None or len(order) < self.batch_items:
            return order, turns
        columns = [slice(self.batch_items)] if len(self.sources) > 1 else self._streams
        tables = [values[: self._used].reshape(-1, self.batch_items) for values in (order, turns)]
        for first in range(0, self.batches_per_epoch, POOL):
            pool = slice(first, min(first + POOL, self.batches_per_epoch))
            # The epoch's own number keeps this draw apart from that of the permutation itself.
            dealt = permutation(pool.stop - first, self.seed, epoch, first * self.batch_items + 1)
            # A stream's rows stay its own, so that nobody else reads its shards.
            for rows in columns:
                lengths = self.lengths[tables[0][pool, rows]]
                by_length = np.argsort(lengths, axis=None, kind="stable").reshape(lengths.shape)[dealt]
                for table in tables:
                    table[pool, rows] = table[pool, rows].ravel()[by_length]
        return order, turns

    def __getstate__(self) -> dict[str, object]:
        names = ("num_items", "batch_items", "seed", "lengths", "sources")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        BatchPlan.__init__(self, **state)
