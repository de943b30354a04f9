"""The features step, for sources that can only be read front to back.

An archive is read once, in its own order, while shards are shuffled: so features are made batch by batch (an
archive is a batch) into a folder, and the shard writer then picks clips from there in its own order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from motionloom.datasets.base.pool import Workers
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.options import WriteOptions
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.tasks import Convert

T = TypeVar("T")
Take = Callable[[T, Path], Sample | list[Sample]]


class FeatureBatch(Protocol):
    """The clips that are read together. Picklable and small: it travels to a worker."""

    @property
    def size(self) -> int:
        """Number of clips."""
        ...

    def is_made(self, folder: Path) -> bool:
        """Whether an earlier run made it from the same inputs."""
        ...

    def make(self, folder: Path) -> None:
        """Convert every clip into files under `folder`. A clip that fails is recorded there, not raised."""
        ...

    def trial(self, seconds: float) -> int:
        """Convert clips for about this long without keeping them; returns how many."""
        ...


@dataclass(frozen=True)
class FeatureStep(Generic[T]):
    """How the features of a conversion are made batch by batch, and how a clip is picked from them."""

    batches: Sequence[FeatureBatch]
    batch_of: Callable[[T], int]
    """Position in `batches` of the batch that an item is in."""
    take: Take[T]
    """The sample of an item, from the files of its batch. Picklable; raises what stopped the clip."""

    def make(
        self,
        items: Sequence[T],
        folder: Path,
        pool: Workers,
        how: WriteOptions,
        say: Callable[[str], None] | None = None,
    ) -> Convert[T]:
        """Make the batches that `items` need and that are not there: all, or those of a part.

        `say` gets a line when an earlier run made some of them. Returns the function from item to sample. A
        part of the shards makes no batch: `UserError` when one is missing.
        """
        needed = sorted({self.batch_of(item) for item in items})
        if how.features_only:
            needed = [position for position in needed if how.has(position)]
        todo = [self.batches[position] for position in needed if not self.batches[position].is_made(folder)]
        if todo and how.part is not None and not how.features_only:
            raise UserError(
                f"{folder}: features of {len(todo)} batches are missing; "
                f"run the parts of step 'features' first"
            )
        made = len(needed) - len(todo)
        if say is not None and made and todo:
            clips = sum(self.batches[position].size for position in needed) - sum(b.size for b in todo)
            say(f"{folder.parent}: goes on after {made:,} of {len(needed):,} batches ({clips:,} clips)")
        if todo:
            folder.mkdir(parents=True, exist_ok=True)
        clips = sum(batch.size for batch in todo)
        with Meter("converting clips", clips, shown=how.progress and bool(items)) as meter:
            for position, _ in pool.run(partial(_make, folder), todo):
                meter.advance(todo[position].size)
        return partial(_take, self.take, folder)


def _make(folder: Path, batch: FeatureBatch) -> None:
    batch.make(folder)


def _take(take: Take[T], folder: Path, item: T) -> Sample | list[Sample]:
    return take(item, folder)
