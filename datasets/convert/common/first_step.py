"""The first of two steps, for sources that can only be read front to back.

An archive is read once, in its own order, while shards are shuffled: so features are made batch by batch (an
archive is a batch) into a folder, and the shard writer then picks clips from there in its own order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from rich.progress import Progress

from motionloom.datasets.base.pool import Workers
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.tasks import Part

T = TypeVar("T")


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
        """Convert clips without keeping them for about so long; how many."""
        ...


@dataclass(frozen=True)
class FirstStep(Generic[T]):
    """How the features of a conversion are made batch by batch."""

    batches: Sequence[FeatureBatch]
    batch_of: Callable[[T], int]
    """Position in `batches` of the batch that an item is in."""
    take: Callable[[T, Path], Sample | list[Sample]]
    """The sample of an item, from the files of its batch. Picklable; raises what stopped the clip."""

    def run(
        self, items: Sequence[T], folder: Path, pool: Workers, *, part: Part | None, progress: bool
    ) -> None:
        """Make the batches that `items` need and that are not there: all, or those of `part`.

        The part of a later step makes none: `UserError` when one is missing.
        """
        needed = sorted({self.batch_of(item) for item in items})
        if part is not None and part.step == "features":
            needed = [position for position in needed if part.has(position)]
        folder.mkdir(parents=True, exist_ok=True)
        todo = [self.batches[position] for position in needed if not self.batches[position].is_made(folder)]
        if todo and part is not None and part.step != "features":
            raise UserError(
                f"{folder}: features of {len(todo)} batches are missing; "
                f"run the parts of step 'features' first"
            )
        with Progress(disable=not progress) as bar:
            shown = bar.add_task("converting clips", total=sum(batch.size for batch in todo))
            for position, _ in pool.run(_Make(folder), todo):
                bar.advance(shown, todo[position].size)


@dataclass(frozen=True)
class Take(Generic[T]):
    """`FirstStep.take` with its folder: the writer's function from item to sample."""

    take: Callable[[T, Path], Sample | list[Sample]]
    folder: Path

    def __call__(self, item: T) -> Sample | list[Sample]:
        """The sample of an item."""
        return self.take(item, self.folder)


@dataclass(frozen=True)
class _Make:
    """`FeatureBatch.make` with its folder, for the pool."""

    folder: Path

    def __call__(self, batch: FeatureBatch) -> None:
        batch.make(self.folder)
