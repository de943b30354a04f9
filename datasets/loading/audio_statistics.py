"""`AudioStats`: per-column mean and standard deviation of the audio features of a training split.

The scales of the 438 columns differ by a factor of thousands (MFCC against a flag), so that a linear layer
needs them normalised. Columns that never change (the first lag of a tempogram is always 1) are divided by 1.
The same `Moments` as for motion: one pass, mergeable over clips, shards and workers.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.loading.statistics import Moments, sorted_header
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset, in_order

MEMBER = "audio.npy"
_CONSTANT = 1e-6
"""A column whose standard deviation is below this share of its size (or of 1) does not change."""


@dataclass(frozen=True)
class AudioStats:
    """Mean and std, [A] float32, of the columns of audio features."""

    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    frames: int = 0
    """Rows they were computed from."""

    @property
    def dim(self) -> int:
        """A, the width of one row."""
        return len(self.mean)

    def normalize(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(values - mean) / std over the last axis of [..., A]."""
        return (values - self.mean) / self.std

    def save(self, path: Path) -> None:
        """Write a safetensors file, atomically; the same statistics give the same bytes."""
        about = {"frames": str(self.frames)}
        with atomic_file(path) as file:
            file.write(sorted_header(save({"mean": self.mean, "std": self.std}, metadata=about)))

    @staticmethod
    def load(path: Path) -> AudioStats:
        """Read what `save` wrote; `UserError` when it is not that."""
        try:
            with safe_open(path, framework="numpy") as stored:
                frames = int((stored.metadata() or {})["frames"])
                mean, std = stored.get_tensor("mean"), stored.get_tensor("std")
        except FileNotFoundError:
            raise UserError(f"{path}: no such file; run the statistics stage") from None
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise UserError(
                f"{path}: not audio statistics ({error}); run the statistics stage again"
            ) from None
        if mean.ndim != 1 or mean.shape != std.shape or not (std > 0).all():
            raise UserError(f"{path}: not columns with positive std; run the statistics stage again")
        return AudioStats(mean, std, frames)


def compute_audio(dataset: ClipDataset, progress: bool = False) -> AudioStats:
    """Statistics of the audio features of every clip of `dataset` that has them, in one pass.

    In a mix each data set counts as often as its weight has it drawn, as in `statistics.compute`.
    """
    parts = dataset.parts()
    total = sum(weight for _, weight in parts)
    moments: Moments | None = None
    for part, weight in parts:
        own: Moments | None = None
        heard = np.flatnonzero(part.has(MEMBER)).tolist()
        for i in track(
            in_order(part, MEMBER, clips=heard),
            "audio statistics",
            total=len(heard),
            disable=not progress,
        ):
            rows = part.audio(i)
            if rows is None:
                continue
            found = Moments.of(rows)
            if own is not None and len(own.mean) != len(found.mean):
                raise UserError(
                    f"{part.where}: clip {part.ids[i]} has {len(found.mean)} audio features a frame, others "
                    f"{len(own.mean)}; convert the data set again"
                )
            own = found if own is None else own.merge(found)
        if own is None:
            continue
        if len(parts) > 1:
            own = own.counted(weight / total * len(dataset) / len(part))
        moments = own if moments is None else moments.merge(own)
    if moments is None:
        raise UserError(
            f"{dataset.where}: no clip of split '{dataset.split}' has audio features; convert a source with "
            f"music, or leave audio out"
        )
    std = moments.std
    constant = std <= _CONSTANT * np.maximum(1.0, np.abs(moments.mean))
    std = np.where(constant, 1.0, std)
    return AudioStats(
        moments.mean.astype(np.float32), std.astype(np.float32), round(float(moments.count.max()))
    )
