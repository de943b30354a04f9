"""The order of one epoch's items: all shuffled, shard by shard, or mixed from several data sets.

Every order here is a pure function of its key. The orders differ in what they ask of the storage: a global
shuffle touches every shard all the time; the streamed order reads a few streams side by side, each one shard
after another. Rows of a batch belong to streams, and so to processes: of 8 streams each of two nodes reads 4,
half of the set, and the order is the one that any other number of nodes has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.randomness import permutation, words

if TYPE_CHECKING:
    from motionloom.datasets.shards.clips import Source

# Last elements of keys. `BatchPlan` draws its pools by (seed, epoch, n >= 1), so a zero in the third place
# keeps these apart from them; no key may end in zero (numpy pads keys with zeros).
_SHARDS = 1
_WITHIN = 2
_MIX = 3


def source_order(source: Source, *key: int) -> NDArray[np.int64]:
    """Return all items of a source once, [count], in the order of the key."""
    if source.shards is None:
        return source.first + permutation(source.count, *key)
    numbers, shard = np.unique(source.shards, return_inverse=True)
    place = np.empty(len(numbers), dtype=np.int64)
    place[permutation(len(numbers), *key, 0, _SHARDS)] = np.arange(len(numbers))
    draws = words(source.count, *key, 0, _WITHIN)
    return source.first + np.lexsort((draws, place[shard] // source.group))


def streamed_order(source: Source, size: int, *key: int) -> NDArray[np.int64]:
    """Items of an epoch in batches of `size`: row by row of a batch first the first stream's next items, then
    the second's. A source of fewer items than a batch is only shuffled.
    """
    # Each shard's clips in random order, the shards one after the other in random order.
    order = source_order(replace(source, group=1), *key)
    batches = len(order) // size
    if not batches:
        return order
    # Streams are stretches of this, as long as their rows of all batches; where one ends within a shard the
    # next goes on, so two streams at most read it. What is left at the end sits this epoch out.
    streams = [
        order[batches * rows.start : batches * rows.stop].reshape(batches, rows.stop - rows.start)
        for rows in stream_rows(source, size)
    ]
    return np.concatenate(streams, axis=1).ravel()


def stream_rows(source: Source, size: int) -> list[slice]:
    """The rows of each stream in a batch of `size`; all are of one where the order is not streamed."""
    count = source.group if source.shards is not None else 1
    return [slice(first, end) for first, end in pairwise(n * size // count for n in range(count + 1))]


def mixed_order(
    sources: Sequence[Source], size: int, seed: int, epoch: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(items [size], turns [size]) of one epoch over several sources.

    Each source gets exactly its share of the `size` places, spread evenly over them, so that every batch
    holds its share to within a clip or two. A source goes on where it stopped in the epoch before: all its
    items come once, in an order of their own each time, before any comes again. `turns` counts these rounds.
    """
    places = []
    items = []
    turns = []
    for number, (source, share) in enumerate(zip(sources, shares(sources, size), strict=True)):
        # A source goes on where the epoch before left it: turn and place are of its own count of draws.
        drawn = np.arange(epoch * share, (epoch + 1) * share)
        turn, place = np.divmod(drawn, source.count)
        for this in range(int(turn[0]), int(turn[-1]) + 1):
            order = source_order(source, seed, this, 0, _MIX, number + 1)
            items.append(order[place[turn == this]])
        turns.append(turn)
        # Its draws lie evenly over the epoch, so that merging by place gives every batch its share.
        places.append((np.arange(share) + 0.5) / share)
    merged = np.argsort(np.concatenate(places), kind="stable")
    return np.concatenate(items)[merged], np.concatenate(turns)[merged]


def shares(sources: Sequence[Source], size: int) -> list[int]:
    """Return each source's share of `size` items, by largest remainder; `UserError` if one would get none."""
    total = sum(source.weight for source in sources)
    wanted = np.array([source.weight / total * size for source in sources])
    counts = np.floor(wanted).astype(np.int64)
    rest = size - int(counts.sum())
    counts[np.argsort(counts - wanted, kind="stable")[:rest]] += 1
    for source, count in zip(sources, counts.tolist(), strict=True):
        if count == 0:
            raise UserError(
                f"{source.name}: weight {source.weight:g} of {total:g} is less than one clip of an epoch of "
                f"{size}; raise the weight or leave the data set out"
            )
    return [int(count) for count in counts]
