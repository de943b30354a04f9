"""Features between the two passes of a converter: one flat file and one index a batch.

Sources pack their clips differently from shards (an archive can only be read front to back, shards are
shuffled), so a converter first writes each batch here, in source order, and the shard writer then picks clips
in its own order. A batch is whole or absent; it is kept on a second run when its fingerprint fits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from motionloom.datasets.schema import Caption, ClipMeta, Config, Dropped, UserError
from motionloom.datasets.shards.files import atomic_file, write_json
from motionloom.datasets.shards.sample import Sample

_VALUES = np.dtype("<f4")


class BatchIndex(Config):
    """What one batch file holds."""

    fingerprint: str
    dim: int
    clips: dict[str, tuple[int, int]]
    """Label -> first frame and number of frames."""
    dropped: list[Dropped]


@dataclass(frozen=True)
class StoredClip:
    """One clip of a batch file, with everything a sample needs; small enough to send to a worker."""

    path: Path
    first: int
    meta: ClipMeta
    texts: tuple[Caption, ...]
    dim: int

    def sample(self) -> Sample:
        """Read the features [T, D] and make the sample."""
        values = np.fromfile(
            self.path,
            dtype=_VALUES,
            count=self.meta.frames * self.dim,
            offset=self.first * self.dim * _VALUES.itemsize,
        )
        motion = values.reshape(self.meta.frames, self.dim).astype(np.float32, copy=False)
        return Sample(meta=self.meta, motion=motion, texts=list(self.texts))

    def source(self) -> str:
        """Name of the clip in reports."""
        return self.meta.source


def stored_batch(path: Path, fingerprint: str) -> BatchIndex | None:
    """The index of a finished batch file, or None when it must be made."""
    index = path.with_suffix(".json")
    if not (index.is_file() and path.is_file()):
        return None
    try:
        found = BatchIndex.model_validate_json(index.read_bytes())
    except ValidationError:
        return None
    frames = sum(count for _, count in found.clips.values())
    whole = path.stat().st_size == frames * found.dim * _VALUES.itemsize
    return found if whole and found.fingerprint == fingerprint else None


def store_batch(
    path: Path, clips: Iterable[tuple[str, NDArray[np.float32] | Dropped]], *, dim: int, fingerprint: str
) -> BatchIndex:
    """Write (label, features [T, D] or the reason for none) of one batch; one clip is in memory at a time."""
    entries: dict[str, tuple[int, int]] = {}
    dropped: list[Dropped] = []
    frames = 0
    with atomic_file(path) as file:
        for label, made in clips:
            if isinstance(made, Dropped):
                dropped.append(made)
                continue
            if made.ndim != 2 or made.shape[1] != dim or label in entries:
                raise UserError(f"{label}: features {list(made.shape)} are not [T, {dim}], or came twice")
            file.write(made.astype(_VALUES, copy=False).tobytes())
            entries[label] = (frames, len(made))
            frames += len(made)
    index = BatchIndex(fingerprint=fingerprint, dim=dim, clips=entries, dropped=dropped)
    write_json(path.with_suffix(".json"), index.dump())
    return index
