"""The features step, for sources that can only be read front to back.

An archive is read once, in its own order, while shards are shuffled: so features are made batch by batch (an
archive is a batch) into a folder, one flat file and one index each, and the shard writer then picks clips
from there in its own order. A batch is whole or absent; it is kept on a second run when it holds what is
wanted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import methodcaller
from pathlib import Path
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import atomic_file, write_json
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.convert.common.plan import C
from motionloom.datasets.schema import Config, Dropped, UserError
from motionloom.datasets.shards.options import WriteOptions
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.tasks import Convert

Features = NDArray[np.float32]

_VALUES = np.dtype("<f4")


class BatchIndex(Config):
    """Index of one batch file."""

    fingerprint: str
    dim: int
    clips: dict[str, tuple[int, int]]
    """Label -> first frame and number of frames."""
    made_from: dict[str, str]
    """Label -> digest of the clip's source, of the dropped ones too."""
    dropped: list[Dropped]


@dataclass(frozen=True)
class FeatureBatch:
    """The clips that are read together. Picklable: it travels to a worker."""

    number: int
    labels: Mapping[str, str]
    """The clips by their labels, with a digest of each one's source."""
    dim: int
    fingerprint: str
    """Digest of what the features of all depend on."""
    clips: Callable[[], Iterator[tuple[str, Features | Dropped]]]
    """(label, features [T, D] or the reason for none) of each clip, one in memory at a time."""

    @property
    def size(self) -> int:
        return len(self.labels)

    def is_made(self, folder: Path) -> bool:
        path = _path(folder, self.number)
        try:
            found = BatchIndex.load_json(path.with_suffix(".json"))
        except UserError:
            return False
        size = sum(count for _, count in found.clips.values()) * found.dim * _VALUES.itemsize
        same = found.fingerprint == self.fingerprint and self.labels.items() <= found.made_from.items()
        return same and path.is_file() and path.stat().st_size == size

    def make(self, folder: Path) -> None:
        """Convert every clip into a file under `folder`. A clip that fails is recorded there, not raised."""
        index = BatchIndex(
            fingerprint=self.fingerprint, dim=self.dim, clips={}, made_from=dict(self.labels), dropped=[]
        )
        frames, path = 0, _path(folder, self.number)
        with atomic_file(path) as file:
            for label, features in self.clips():
                if isinstance(features, Dropped):
                    index.dropped.append(features)
                    continue
                if features.ndim != 2 or features.shape[1] != self.dim or label in index.clips:
                    raise UserError(
                        f"{label}: features {list(features.shape)} are not [T, {self.dim}], or came twice"
                    )
                file.write(features.astype(_VALUES, copy=False).tobytes())
                index.clips[label] = (frames, len(features))
                frames += len(features)
        write_json(path.with_suffix(".json"), index.dump())


@dataclass(frozen=True)
class FeatureStep(Generic[C]):
    """The features of a conversion: made batch by batch, and picked clip by clip."""

    batches: Sequence[FeatureBatch]
    number_of: Callable[[C], int]
    """Number of the batch that a clip is in. Picklable."""
    sample: Callable[[C, Features], Sample]
    """The sample of a clip with its features. Picklable."""

    def make(
        self, clips: Sequence[C], folder: Path, pool: Workers, how: WriteOptions, say: Callable[[str], None]
    ) -> Convert[C]:
        """Make the batches that `clips` need and that are not there: all, or those of a part.

        `say` gets a line when an earlier run made some of them. Returns the function from clip to sample. A
        part of the shards makes no batch: `UserError` when one is missing.
        """
        numbers = {self.number_of(clip) for clip in clips}
        needed = [(at, batch) for at, batch in enumerate(self.batches) if batch.number in numbers]
        if how.features_only:
            needed = [(at, batch) for at, batch in needed if how.has(at)]
        todo = [batch for _, batch in needed if not batch.is_made(folder)]
        if todo and how.part is not None and not how.features_only:
            raise UserError(
                f"{folder}: features of {len(todo)} batches are missing; "
                f"run the parts of step 'features' first"
            )
        left = sum(batch.size for batch in todo)
        kept = len(needed) - len(todo)
        if kept and todo:
            count = sum(batch.size for _, batch in needed) - left
            say(f"{folder.parent}: goes on after {kept:,} of {len(needed):,} batches ({count:,} clips)")
        if todo:
            folder.mkdir(parents=True, exist_ok=True)
        with Meter("converting clips", left, shown=how.progress and bool(clips)) as meter:
            for position, _ in pool.run(methodcaller("make", folder), todo):
                meter.advance(todo[position].size)
        return partial(_take, self.sample, self.number_of, folder)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.bin"


def _take(
    sample: Callable[[C, Features], Sample], number_of: Callable[[C], int], folder: Path, clip: C
) -> Sample:
    return sample(clip, _stored_features(_path(folder, number_of(clip)), clip.label()))


def _stored_features(path: Path, label: str) -> Features:
    index_file = path.with_suffix(".json")
    index = _open(index_file, index_file.stat().st_mtime_ns)
    if label not in index.clips:
        reasons = [drop.reason for drop in index.dropped if drop.source == label]
        raise UserError(reasons[-1] if reasons else "not in its batch; convert again")
    first, frames = index.clips[label]
    values = np.fromfile(
        path, dtype=_VALUES, count=frames * index.dim, offset=first * index.dim * _VALUES.itemsize
    )
    return values.reshape(frames, index.dim).astype(np.float32, copy=False)


@lru_cache(maxsize=256)
def _open(path: Path, changed: int) -> BatchIndex:
    """Clips of one shard come from many batches, so indices are kept; `changed` tells versions apart."""
    return BatchIndex.load_json(path)
