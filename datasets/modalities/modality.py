"""`Modality`: all that the framework asks about one thing that motion can be conditioned on.

A record names the shard members it reads, makes `Condition`s of them for training and of prompts for
generation, and says whether it needs statistics. Batches, drop-out, guidance, stages and prompts take the
names from the table (`table.py`), so a new modality is its record, given to `register`. Importing a record
brings in neither torch nor audio libraries: the shard format asks for member names only.

Legend: B rows of a batch, L positions, T frames of motion, E features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file, sorted_header
from motionloom.datasets.base.json_doors import require_plain, whole

if TYPE_CHECKING:
    from motionloom.datasets.conditions import Condition


Columns = NDArray[np.float32]


def save_columns(path: Path, mean: Columns, std: Columns, frames: int, **about: str) -> None:
    """Write the statistics of columns, [D] each, as a safetensors file, atomically."""
    facts = {**about, "frames": str(frames)}
    with atomic_file(path) as file:
        file.write(sorted_header(save({"mean": mean, "std": std}, metadata=facts)))


def load_columns(path: Path, stage: str) -> tuple[Columns, Columns, int, dict[str, str]]:
    """Read what `save_columns` wrote; `UserError` when it is not that. `stage` is the one to run again."""
    try:
        require_plain(path)
        with safe_open(path, framework="numpy") as stored:
            mean = stored.get_tensor("mean")
            std = stored.get_tensor("std")
            about = stored.metadata() or {}
        frames = whole(about["frames"], f"{path}: frames")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; run {stage}") from None
    except (SafetensorError, OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not a statistics file ({error}); run {stage} again") from None
    numbers = mean.ndim == 1 and mean.shape == std.shape and np.isfinite([mean, std]).all()
    if not numbers or not (std > 0).all():
        raise UserError(f"{path}: not finite columns with positive std; run {stage} again")
    return mean, std, frames, about


@dataclass(frozen=True)
class FrameStats:
    """Mean and std, [E] float32, of the columns of one modality's features, such as the 438 of music.

    The scales of columns differ by a factor of thousands (MFCC against a flag), so that a linear layer needs
    them normalised. `loading/statistics.py` computes them.
    """

    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    frames: int = 0
    """Rows they were computed from."""
    rate: float | None = None
    """Rows a second that what a person gives is analysed at, each then lasting several frames of the motion;
    None = one for every frame."""

    @property
    def dim(self) -> int:
        return len(self.mean)

    def normalize(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(values - mean) / std over the last axis of [..., E]."""
        return (values - self.mean) / self.std

    def save(self, path: Path) -> None:
        """Write a safetensors file, atomically; the same statistics give the same bytes."""
        rate = {} if self.rate is None else {"rate": str(self.rate)}
        save_columns(path, self.mean, self.std, self.frames, **rate)

    @staticmethod
    def load(path: Path) -> FrameStats:
        """Read what `save` wrote; `UserError` when it is not that."""
        mean, std, frames, about = load_columns(path, "its stage")
        try:
            rate = float(about["rate"]) if "rate" in about else None
        except ValueError:
            raise UserError(
                f"{path}: not a statistics file (rate '{about['rate']}'); run its stage again"
            ) from None
        return FrameStats(mean, std, frames, rate)


class Clips(Protocol):
    """The part of a data set of clips that a record reads (`shards/clips.py`)."""

    @property
    def where(self) -> str: ...

    @property
    def ids(self) -> Sequence[str]: ...

    @property
    def frames(self) -> NDArray[np.int64]:
        """T of every clip, [n]."""

    def array(self, i: int, member: str) -> NDArray[np.float32] | None:
        """Features of clip `i`, [L, E]."""


class Rows(NamedTuple):
    """Rows of a training batch, as a modality reads them."""

    clips: NDArray[np.int64]
    """Clip numbers, [B]."""
    present: NDArray[np.bool_]
    """Rows that come with the modality, [B]; the others stay empty."""
    begin: NDArray[np.int64]
    """First frame of each row's window, [B]."""
    length: NDArray[np.int64]
    """Frames of each window, [B]."""
    frames: int
    """T, frames of the longest window."""
    captions: Sequence[str]
    """The caption that each window is about, empty without one."""


class Modality(ABC):
    """One modality."""

    name: str
    """In recipes, batches and prompts; also the stage that prepares it."""
    members: tuple[str, ...]
    """Shard members; a clip has the modality if it has the first."""
    timed: bool = False
    """Whether its positions are the motion's frames, one for one."""
    width: int | None = None
    """Columns of one frame's features, of a modality that is normalised by statistics of the training split;
    a stage of the modality's name computes them."""

    def reader(self, prepared: object) -> object:
        """Return the reader that `batch` takes, made from the output of the modality's stage."""
        return prepared

    @abstractmethod
    def batch(self, reader: object, dataset: Clips, rows: Rows) -> Condition:
        """The condition of a training batch, normalised: features [B, L, E], mask [B, L] false in rows that
        lack it. `UserError` names a clip whose features do not fit its motion.
        """

    @abstractmethod
    def encode(self, prepared: object, values: Sequence[object | None], fps: float) -> Condition:
        """The condition [B, L, E] of what people give for motion at `fps`, one entry a row, None without;
        not normalised yet. `UserError` for what cannot be used.
        """

    def normalise(self, prepared: object, condition: Condition) -> Condition:
        """An encoded condition as training saw it."""
        return condition

    @abstractmethod
    def example(self, batch: int, frames: int, width: int) -> Condition:
        """A condition of the largest usual size, [batch, L, width], to measure memory with."""

    def seconds(self, value: object) -> float | None:
        """Length of what a person gives; None where it has none."""
        return None

    def ticks(self, value: object, features: NDArray[np.float32], fps: float) -> list[float]:
        """Seconds of moments worth marking on a time line, such as beats, of encoded features [L, E]."""
        return []


def condition_of(*parts: NDArray[np.generic]) -> Condition:
    """Return the condition of arrays: features [B, L, E], mask [B, L], and pooled [B, E] where it has any."""
    import torch

    from motionloom.datasets.conditions import Condition

    return Condition(*map(torch.as_tensor, parts))


class FrameModality(Modality):
    """A modality of numbers, a row for each frame of the motion: one `.npy` member and statistics."""

    timed = True

    def batch(self, reader: object, dataset: Clips, rows: Rows) -> Condition:
        assert isinstance(reader, FrameStats)
        features = np.zeros((len(rows.clips), rows.frames, reader.dim), dtype=np.float32)
        # Rows without the modality stay zero and masked, so that one batch may mix all kinds of clips.
        mask = (np.arange(rows.frames)[None] < rows.length[:, None]) & rows.present[:, None]
        for row in np.flatnonzero(rows.present).tolist():
            stored = self._stored(dataset, int(rows.clips[row]), reader.dim)
            first = int(rows.begin[row])
            count = int(rows.length[row])
            features[row, :count] = reader.normalize(stored[first : first + count])
        return condition_of(features, mask)

    def _stored(self, dataset: Clips, clip: int, width: int) -> NDArray[np.float32]:
        """Return a clip's features [T, E]; `UserError` unless they are one row a frame."""
        features = dataset.array(clip, self.members[0])
        frames = int(dataset.frames[clip])
        if features is None or features.shape != (frames, width):
            shape = "none" if features is None else str(list(features.shape))
            raise UserError(
                f"{dataset.where}: clip {dataset.ids[clip]} has {self.name} features {shape} for {frames} "
                f"frames of motion, expected [{frames}, {width}]; convert it with one row a motion frame "
                f"({self.name}_fps equal to fps)"
            )
        return features

    def encode(self, prepared: object, values: Sequence[object | None], fps: float) -> Condition:
        rows = [None if value is None else self.features(value, fps, prepared) for value in values]
        some = [row for row in rows if row is not None]
        features = np.zeros((len(rows), max(map(len, some)), some[0].shape[1]), dtype=np.float32)
        mask = np.zeros(features.shape[:2], dtype=np.bool_)
        for k, row in enumerate(rows):
            if row is not None:
                features[k, : len(row)] = row
                mask[k, : len(row)] = True
        return condition_of(features, mask)

    def features(self, value: object, fps: float, prepared: object = None) -> NDArray[np.float32]:
        """Return features [T, E] of a person's input, a row for each frame; an array is taken as it is."""
        if not isinstance(value, np.ndarray) or value.ndim != 2:
            raise UserError(f"{self.name}: give its features, an array [frames, {self.width}]")
        return np.asarray(value, np.float32)

    def normalise(self, prepared: object, condition: Condition) -> Condition:
        """Return the condition normalised by the statistics; zero where the mask is false."""
        import torch

        if not isinstance(prepared, FrameStats):
            raise UserError(f"this model was trained without {self.name}; leave it out")
        features, mask, _ = condition
        mean, std = (torch.from_numpy(values).to(features) for values in (prepared.mean, prepared.std))
        return condition._replace(features=((features - mean) / std).masked_fill(~mask[..., None], 0.0))

    def example(self, batch: int, frames: int, width: int) -> Condition:
        return condition_of(np.empty((batch, frames, width), np.float32), np.ones((batch, frames), np.bool_))
