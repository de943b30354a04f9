"""The loader of a chunk: one reader behind all of them, and what the training waits for is counted."""

from __future__ import annotations

import time
from collections.abc import Iterator

import torch

from motionloom.pipeline.flight.waits import Waits
from motionloom.pipeline.stages.loading import ChunkLoader
from motionloom.pipeline.stages.saving import _mean


class Reader:
    """Numbers from the one asked for; notes how often it was begun."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.begun: list[int] = []
        self.seconds = seconds

    def __call__(self, first: int) -> Iterator[int]:
        self.begun.append(first)
        while True:
            time.sleep(self.seconds)
            yield first
            first += 1


def test_one_reader_gives_all_chunks() -> None:
    reader, at = Reader(), [0]
    loader = ChunkLoader(reader, lambda: at[0], 6, Waits())
    assert len(loader) == 6
    for first in (0, 6, 12):
        at[0] = first
        assert list(loader) == list(range(first, first + 6))
    assert reader.begun == [0]


def test_it_begins_in_the_middle_of_a_chunk_and_ends_with_it() -> None:
    reader, at = Reader(), [10]
    loader = ChunkLoader(reader, lambda: at[0], 6, Waits())
    iter(loader)  # Lightning looks whether it can be iterated
    assert list(loader) == [10, 11]
    at[0] = 12
    assert list(loader) == list(range(12, 18))
    assert reader.begun == [10]
    at[0] = 30  # another training position: from there
    assert next(iter(loader)) == 30 and reader.begun == [10, 30]


def test_waits_are_those_for_the_reader() -> None:
    waits = Waits()
    batches = iter(ChunkLoader(Reader(0.01), lambda: 0, 4, waits))
    next(batches)
    first = waits.data
    assert first >= 0.01
    time.sleep(0.05)  # a step
    assert waits.data == first
    next(batches)
    assert waits.data >= 0.02 and waits.checkpoints == 0
    with waits.for_checkpoints():
        time.sleep(0.01)
    assert waits.checkpoints >= 0.01


def test_another_number_of_ranks_goes_on_with_the_mean_of_a_row() -> None:
    sums = torch.tensor([[1.0, 4.0], [3.0, 8.0]])
    rows = [[{"names": ["loss", "recon"], "sums": row, "count": 3}] for row in sums]
    (mean,) = _mean(rows)  # type: ignore[arg-type]
    assert mean["names"] == ["loss", "recon"] and mean["count"] == 3
    assert torch.equal(mean["sums"], torch.tensor([2.0, 6.0]))
