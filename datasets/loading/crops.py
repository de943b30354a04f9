"""Copying pieces of clips into one normalised, zero-padded batch array: the loader's inner loop.

A window is subtracted and scaled while it is in the processor's cache, straight from what was read of the tar
into its place in the batch: no tensor per sample. It is treated as one long row (mean and scale repeated per
frame), which halves the time of broadcasting over rows. A process that trains on a small data set keeps the
normalised clips and only copies; loader workers, which are many, read them anew.

Columns of a part that a clip does not hold (hands, face) come out as 0, the mean, whatever the file stores.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.layout import require_layout
from motionloom.datasets.shards.clips import ClipDataset


class CaptionSpan(NamedTuple):
    """A caption and its stretch of a clip, in frames."""

    text: str
    first: int
    end: int
    """The frame after the last."""
    tokens: tuple[str, ...] = ()
    """Its `word/POS` tags, where the source brings them."""

    @property
    def frames(self) -> int:
        return self.end - self.first


def frame_span(caption: Caption, fps: float, frames: int) -> tuple[int, int]:
    """(first frame, frame after the last) of a caption's stretch in a clip of `frames`; all when empty."""
    first = min(max(round(caption.start * fps), 0), frames)
    end = frames if caption.end is None else min(max(round(caption.end * fps), 0), frames)
    return (first, end) if end > first else (0, frames)


def caption_spans(
    captions: Sequence[Caption], fps: float, frames: int, min_frames: int = 1
) -> list[CaptionSpan]:
    """The captions that cover `min_frames` or more of a clip of `frames`.

    When none does, the one that covers most: a clip with a caption always gives one.
    """
    spans = [
        CaptionSpan(caption.text, *frame_span(caption, fps, frames), tuple(caption.tokens or ()))
        for caption in captions
    ]
    long = [span for span in spans if span.frames >= min_frames]
    return long or ([max(spans, key=lambda span: span.frames)] if spans else [])


KEPT_BYTES = 2**29
"""Size up to which a data set's normalised columns are kept: 512 whole-body clips of 196 frames are 2**27."""


_ROOMS = 2
"""Batches whose memory is kept: the one that is computed, and the one that is being made meanwhile."""
_PROBE = [np.empty(0, dtype=np.float32)]
_ALONE = sys.getrefcount(_PROBE[0])
"""References of an array that one list alone holds, as this Python counts them."""


class Cut(NamedTuple):
    """Stretches of clips as one batch."""

    motion: NDArray[np.float32]
    """[B, T, C], zeros after each row's `length`."""
    begin: NDArray[np.int64]
    """First frame in the clip, [B]."""
    length: NDArray[np.int64]
    closed: NDArray[np.bool_]
    """Whether the row is the whole stretch that was asked for, [B]."""
    present: NDArray[np.bool_]
    """Columns that each clip holds, [B, C]."""


class Crops:
    """Reads normalised pieces of a dataset's clips, all columns or some (`columns`, ascending, [C])."""

    def __init__(
        self, dataset: ClipDataset, stats: FeatureStats, columns: NDArray[np.int64] | None = None
    ) -> None:
        require_layout(stats.layout, dataset.layout, "feature statistics")
        chosen = np.arange(dataset.layout.dim) if columns is None else np.asarray(columns)
        if len(chosen) == 0 or chosen.min() < 0 or chosen.max() >= dataset.layout.dim:
            raise UserError(f"columns outside layout {dataset.layout.name} (or none of them)")
        self.dataset = dataset
        self.width = len(chosen)
        self.present = dataset.layout.present_columns[:, chosen]
        """Row b: which of the columns clips hold that hold the bits b, [4, C]."""
        some = np.asarray(self.present.any(axis=1))
        self.clips = np.flatnonzero(some[dataset.present])
        """Clips that hold any of the columns: the others have nothing to give, [n]."""
        self._missing = [[place for place, _ in _runs(np.flatnonzero(~row))] for row in self.present]
        self._mean = stats.mean[chosen]
        self._scale = 1.0 / stats.std[chosen]
        self._mean_row = self._mean
        self._scale_row = self._scale
        self._runs = _runs(chosen)
        self._keep()

    def _keep(self) -> None:
        """Keep what is read from here on, where all of it is small enough, and the memory of batches."""
        size = 4 * self.width * int(self.dataset.frames.sum())
        self._kept: dict[int, NDArray[np.float32]] | None = {} if size <= KEPT_BYTES else None
        self._rooms: list[NDArray[np.float32]] = []

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_kept": None, "_rooms": []}

    def fill(self, out: NDArray[np.float32], clip: int, start: int, length: int) -> None:
        """Normalised frames `start .. start + length` of a clip into `out` [T >= length, C], then zeros."""
        if self._kept is None:
            self._read(out[:length], clip, start)
        else:
            whole = self._kept.get(clip)
            if whole is None:
                whole = np.empty((int(self.dataset.frames[clip]), self.width), dtype=np.float32)
                self._read(whole, clip, 0)
                self._kept[clip] = whole
            out[:length] = whole[start : start + length]
        if length < len(out):
            out[length:] = 0.0

    def _read(self, out: NDArray[np.float32], clip: int, start: int) -> None:
        """Normalised frames of a clip from `start` on, `out` [T, C]."""
        frames = self.dataset.motion(clip, start, start + len(out))
        for source, place in self._runs:
            out[:, place] = frames[:, source]
        row = out.reshape(-1)  # a view: it is contiguous
        mean, scale = self._repeated(len(out))
        np.subtract(row, mean, out=row)
        np.multiply(row, scale, out=row)
        # Whatever the file stores for parts that the clip does not hold, the batch has the mean.
        for place in self._missing[self.dataset.present[clip]]:
            out[:, place] = 0.0

    def cut(
        self, clips: NDArray[np.int64], spans: Sequence[CaptionSpan], at: NDArray[np.float64], most: int
    ) -> Cut:
        """The spans of `clips` [B]; one longer than `most` frames is cropped at `at` [B] in [0, 1)."""
        begin, length, closed = places(spans, at, most)
        motion = self._room(len(clips), padded_length(length), self.width)
        for row, clip in enumerate(clips.tolist()):
            self.fill(motion[row], clip, int(begin[row]), int(length[row]))
        return Cut(motion, begin, length, closed, self.present[self.dataset.present[clips]])

    def _room(self, *shape: int) -> NDArray[np.float32]:
        """Return an array for a batch, of any content, in the memory of an earlier one that nobody holds any
        more if there is one.

        Neither numpy nor malloc keeps 32 MB or more for the next time, and the first writing to new pages
        takes nearly as long as the copy: 256 x 196 x 313 numbers 18.5 ms instead of 11. A ring of arrays
        would write over batches that a caller still holds.
        """
        size = math.prod(shape)
        for n in range(len(self._rooms)):
            # An array, a tensor or a view of a batch holds its room: free is one that the list alone holds.
            if len(self._rooms[n]) >= size and sys.getrefcount(self._rooms[n]) == _ALONE:
                return self._rooms[n][:size].reshape(shape)
        room = np.empty(size, dtype=np.float32)
        self._rooms = [*self._rooms, room][-_ROOMS:]
        return room.reshape(shape)

    def _repeated(self, length: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and scale of `length` frames as one row; kept for the longest length asked for."""
        size = length * self.width
        if len(self._mean_row) < size:
            self._mean_row, self._scale_row = np.tile(self._mean, length), np.tile(self._scale, length)
        return self._mean_row[:size], self._scale_row[:size]


def places(
    spans: Sequence[CaptionSpan], at: NDArray[np.float64], most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """First frame, length and whether it is whole, each [B], of spans cropped at `at` [B] to `most`."""
    whole = np.array([span.frames for span in spans], dtype=np.int64)
    length = np.minimum(whole, most)
    begin = np.array([span.first for span in spans], dtype=np.int64)
    begin += (at * (whole - length + 1)).astype(np.int64)
    return begin, length, length == whole


def _runs(columns: NDArray[np.int64]) -> list[tuple[slice, slice]]:
    """(slice of the clip's columns, slice of the batch's columns) for each run of neighbouring columns."""
    if len(columns) == 0:
        return []
    breaks = np.flatnonzero(np.diff(columns) != 1) + 1
    edges = [0, *breaks.tolist(), len(columns)]
    return [(slice(int(columns[a]), int(columns[b - 1]) + 1), slice(a, b)) for a, b in pairwise(edges)]


def padded_length(lengths: NDArray[np.int64]) -> int:
    """The longest length, rounded up to a multiple of 4, which the tokenizers' down-sampling divides."""
    return -(-int(lengths.max()) // 4) * 4
