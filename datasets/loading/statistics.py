"""Mean and standard deviation of each column of motion (`FeatureStats`, as models normalise by them) and of a
modality, in one pass.

A column counts the clips that hold it: what a clip without hands or face stores there is ignored. A column
that no clip holds gets mean 0 and standard deviation 1.

`Moments` holds (count, mean, sum of squared deviations) and merges by Chan's formula, so clips, shards and
workers may be combined in any grouping. Statistics come from the training split only; whoever calls `compute`
decides that by the dataset it passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import number, read_plain
from motionloom.datasets.modalities.modality import FrameStats, Modality, load_columns, save_columns
from motionloom.datasets.motion.layout import ROOT, Family, MotionLayout

if TYPE_CHECKING:
    from motionloom.datasets.shards.clips import ClipDataset

STD_FLOOR = 1e-4
"""Columns that hardly move (a hand the source does not record) are divided by this, not by zero."""


Values = NDArray[np.float32]
Columns = NDArray[np.int64] | slice
"""Columns of a layout: by number, or a field's slice."""


@dataclass(frozen=True)
class FeatureStats:
    """Mean and std, [D] float32, of the columns of a layout."""

    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    layout: MotionLayout
    frames: int = 0
    """Frames they were computed from."""

    def normalize(self, values: Values, columns: Columns | None = None) -> Values:
        """(values - mean) / std over the last axis. `columns`: which ones `values` holds."""
        chosen = slice(None) if columns is None else columns
        return (values - self.mean[chosen]) / self.std[chosen]

    def denormalize(self, values: Values, columns: Columns | None = None) -> Values:
        """values * std + mean over the last axis, likewise."""
        chosen = slice(None) if columns is None else columns
        return values * self.std[chosen] + self.mean[chosen]

    def with_root(self, gain: float) -> FeatureStats:
        """Return statistics by which the columns of the root come out `gain` times as large."""
        std = self.std.copy()
        for name in ROOT:
            if self.layout.has(name):
                std[self.layout.slice(name)] /= gain
        return replace(self, std=std)

    @staticmethod
    def unit(layout: MotionLayout) -> FeatureStats:
        """Return statistics that change nothing: mean 0, std 1."""
        return FeatureStats(np.zeros(layout.dim, np.float32), np.ones(layout.dim, np.float32), layout)

    def save(self, path: Path) -> None:
        """Write a safetensors file, with the layout in its metadata, atomically."""
        layout = self.layout
        facts = {"layout": layout.name, "family": layout.family, "fps": repr(layout.fps)}
        save_columns(path, self.mean, self.std, self.frames, **facts)

    @staticmethod
    def load(path: Path) -> FeatureStats:
        """Read what `save` wrote; `UserError` when it is not that."""
        stage = "the statistics stage"
        mean, std, frames, about = load_columns(path, stage)
        try:
            family = cast(Family, about["family"])  # a wrong one fits no data set
            layout = MotionLayout.named(
                about["layout"], fps=number(about["fps"], f"{path}: fps", 1000, 0.1), family=family
            )
        except (KeyError, ValueError) as error:
            raise UserError(f"{path}: not a statistics file ({error}); run {stage} again") from None
        if len(mean) != layout.dim:
            raise UserError(f"{path}: {len(mean)} columns, not {layout.dim}; run {stage} again")
        return FeatureStats(mean, std, layout, frames)

    @staticmethod
    def of_arrays(mean: Path, std: Path, layout: MotionLayout) -> FeatureStats:
        """Read a release's `.npy` files [D] of a layout's columns; `UserError` where a file is not that."""
        from motionloom.datasets.shards.tar import npy_from_bytes

        arrays = []
        for path in (mean, std):
            try:
                values = npy_from_bytes(read_plain(path, _MOST_BYTES), str(path))
            except OSError as error:
                raise UserError(f"{path}: cannot be read as an array of numbers ({error})") from None
            if values.shape != (layout.dim,) or values.dtype.kind != "f" or not np.isfinite(values).all():
                raise UserError(
                    f"{path}: {values.dtype} {list(values.shape)} is not the {layout.dim} finite numbers of "
                    f"layout {layout.name}; take the statistics of this layout"
                )
            arrays.append(np.asarray(values, dtype=np.float32))
        if not (arrays[1] > 0).all():
            raise UserError(
                f"{std}: holds deviations that are not above 0; exchange `mean` and `std`, perhaps"
            )
        return FeatureStats(arrays[0], arrays[1], layout)


@dataclass(frozen=True)
class Moments:
    """Streaming mean and variance of rows, float64, all [D]; `count` is of rows that hold the column."""

    count: NDArray[np.float64]
    mean: NDArray[np.float64]
    m2: NDArray[np.float64]

    @staticmethod
    def none(width: int) -> Moments:
        return Moments(np.zeros(width), np.zeros(width), np.zeros(width))

    @staticmethod
    def of(rows: NDArray[np.floating], present: NDArray[np.bool_] | None = None) -> Moments:
        """Moments of one array [T, D]; `present` [D] marks the columns that count (None: all)."""
        mean = rows.mean(axis=0, dtype=np.float64)
        m2 = np.square(rows - mean).sum(axis=0)
        count = np.full(len(mean), float(len(rows)))
        if present is None or present.all():
            return Moments(count, mean, m2)
        return Moments(*(np.where(present, values, 0.0) for values in (count, mean, m2)))

    def merge(self, other: Moments) -> Moments:
        count = self.count + other.count
        rows = np.where(count > 0, count, 1.0)
        # Chan et al. 1983: any grouping gives the same, and nothing cancels as in sums of squares.
        delta = other.mean - self.mean
        mean = self.mean + delta * (other.count / rows)
        m2 = self.m2 + other.m2 + np.square(delta) * (self.count * other.count / rows)
        return Moments(count, mean, m2)

    def counted(self, times: float) -> Moments:
        """Return the moments of every row repeated so many times."""
        return Moments(self.count * times, self.mean, self.m2 * times)

    @property
    def std(self) -> NDArray[np.float64]:
        """Population standard deviation, [D]; 0 of a column without rows."""
        return np.sqrt(self.m2 / np.where(self.count > 0, self.count, 1.0))


def compute(dataset: ClipDataset, group: bool = False) -> FeatureStats:
    """Statistics of every frame of `dataset`, in one pass.

    `group` gives all columns of one feature field the mean of their stds, as HumanML3D does, so that a
    field's joints keep their relative sizes. In a mix each data set counts as often as its weight has it
    drawn: with weights equal to the numbers of clips this is the statistics of all clips together.
    """
    layout = dataset.layout

    def moments_of(part: ClipDataset) -> Iterator[Moments]:
        for i in range(len(part)):
            yield Moments.of(part.motion(i), layout.present_columns[part.present[i]])

    return from_moments(_pooled(dataset, moments_of) or Moments.none(layout.dim), layout, group=group)


def _pooled(dataset: ClipDataset, moments_of: Callable[[ClipDataset], Iterator[Moments]]) -> Moments | None:
    """The moments of all clips; in a mix each data set counts as often as its weight has it drawn."""
    parts = dataset.parts()
    total = sum(weight for _, weight in parts)
    pooled: Moments | None = None
    for part, weight in parts:
        own: Moments | None = None
        for moments in moments_of(part):
            own = moments if own is None else own.merge(moments)
        if own is not None:
            if len(parts) > 1:  # as often as its weight has it drawn, not as often as it has clips
                own = own.counted(weight / total * len(dataset) / len(part))
            pooled = own if pooled is None else pooled.merge(own)
    return pooled


def from_moments(moments: Moments, layout: MotionLayout, *, group: bool = False) -> FeatureStats:
    """Finish moments (merged from wherever) into statistics."""
    frames = round(moments.count.max())
    if frames == 0:
        raise UserError("no frames to compute feature statistics from: the training split is empty")
    std = moments.std
    counted = moments.count > 0
    if group:
        for name, _ in layout.fields:
            field = np.arange(layout.dim)[layout.slice(name)]
            field = field[counted[field]]
            if len(field):
                std[field] = std[field].mean()
    std = np.where(counted, np.maximum(std, STD_FLOOR), 1.0)
    return FeatureStats(moments.mean.astype(np.float32), std.astype(np.float32), layout, frames)


_MOST_BYTES = 2**20
"""Largest file of a mean or a deviation: a layout has some hundreds of columns."""

_CONSTANT = 1e-6
"""A column whose standard deviation is below this share of its size (or of 1) does not change."""


def frame_statistics(dataset: ClipDataset, modality: Modality) -> FrameStats:
    """Statistics of a modality's features over every clip of `dataset` that has them, in one pass.

    In a mix each data set counts as often as its weight has it drawn, as in `compute`.
    """
    member = modality.members[0]
    widths: set[int] = set()

    def moments_of(part: ClipDataset) -> Iterator[Moments]:
        for i in np.flatnonzero(part.has(member)).tolist():
            rows = part.array(i, member)
            if rows is None:
                continue
            widths.add(rows.shape[1])
            if len(widths) > 1:
                raise UserError(
                    f"{part.where}: clip {part.ids[i]} has {rows.shape[1]} {modality.name} features a "
                    f"frame, others {min(widths - {rows.shape[1]})}; convert the data set again"
                )
            yield Moments.of(rows)

    moments = _pooled(dataset, moments_of)
    if moments is None:
        raise UserError(
            f"{dataset.where}: no clip of split '{dataset.split}' has {modality.name} features; convert a "
            f"source with {modality.name}, or leave it out"
        )
    # A column that never changes would be divided by rounding; it is left as it is.
    std = moments.std
    constant = std <= _CONSTANT * np.maximum(1.0, np.abs(moments.mean))
    std = np.where(constant, 1.0, std)
    return FrameStats(
        moments.mean.astype(np.float32), std.astype(np.float32), round(float(moments.count.max()))
    )
