"""Features between the two passes of a converter: one flat file and one index a batch.

A batch is whole or absent; it is kept on a second run when its fingerprint fits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import atomic_file, write_json
from motionloom.datasets.schema import Config, Dropped, UserError

_VALUES = np.dtype("<f4")


class BatchIndex(Config):
    """What one batch file holds."""

    fingerprint: str
    dim: int
    clips: dict[str, tuple[int, int]]
    """Label -> first frame and number of frames."""
    dropped: list[Dropped]


def stored_batch(path: Path, fingerprint: str) -> BatchIndex | None:
    """The index of a finished batch file, or None when it must be made."""
    try:
        found = BatchIndex.load_json(path.with_suffix(".json"))
    except UserError:
        return None
    frames = sum(count for _, count in found.clips.values())
    whole = path.is_file() and path.stat().st_size == frames * found.dim * _VALUES.itemsize
    return found if whole and found.fingerprint == fingerprint else None


def store_batch(
    path: Path, clips: Iterable[tuple[str, NDArray[np.float32] | Dropped]], *, dim: int, fingerprint: str
) -> None:
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


def stored_features(path: Path, label: str) -> NDArray[np.float32]:
    """Features [T, D] of one clip of a batch file; `UserError` with the reason when there are none."""
    index_file = path.with_suffix(".json")
    index = _open(index_file, index_file.stat().st_mtime_ns)
    if label not in index.clips:
        raise UserError(index.reasons.get(label, "not in its batch; convert again"))
    first, frames = index.clips[label]
    values = np.fromfile(
        path, dtype=_VALUES, count=frames * index.dim, offset=first * index.dim * _VALUES.itemsize
    )
    return values.reshape(frames, index.dim).astype(np.float32, copy=False)


@dataclass(frozen=True)
class _OpenIndex:
    dim: int
    clips: dict[str, tuple[int, int]]
    reasons: dict[str, str]


@lru_cache(maxsize=256)
def _open(path: Path, changed: int) -> _OpenIndex:
    """Clips of one shard come from many batches, so indices are kept; `changed` tells versions apart."""
    index = BatchIndex.load_json(path)
    return _OpenIndex(index.dim, index.clips, {drop.source: drop.reason for drop in index.dropped})
