"""`MixedDataset`: several data sets of one layout as one, drawn by weight.

Clips are numbered consecutively, data set after data set. How often each data set is drawn is up to the
batch plan (`order.mixed_order`): an epoch has as many places as all the data sets together have clips,
whatever the weights, and each data set gets exactly its share of them. With a large weight the clips of a
small data set are drawn several times an epoch (with new windows and captions each time); with a small
weight it takes several epochs to go once through a large one. Evaluation ignores the weights: it sees every
clip of every data set once.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption, ClipMeta
from motionloom.datasets.motion.layout import require_layout
from motionloom.datasets.shards.clips import ClipDataset, Source


class MixedDataset:
    """A `ClipDataset` of others. `parts` are (data set, weight > 0), all of one split."""

    def __init__(self, parts: Sequence[tuple[ClipDataset, float]]) -> None:
        if not parts:
            raise UserError("a mix needs at least one data set")
        self._parts = list(parts)
        self._datasets = [dataset for dataset, _ in parts]
        one = self._datasets[0]
        for other, weight in parts:
            if not 0 < weight < float("inf"):
                raise UserError(f"{other.where}: weight {weight} in a mix; weights are positive numbers")
            require_layout(other.layout, one.layout, other.where)
        self.where = " + ".join(dataset.where for dataset in self._datasets)
        self.split = one.split
        self.layout = one.layout
        self._first = list(accumulate(map(len, self._datasets), initial=0))

    def __len__(self) -> int:
        return self._first[-1]

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        return np.concatenate([dataset.frames for dataset in self._datasets])

    @cached_property
    def present(self) -> NDArray[np.uint8]:
        return np.concatenate([dataset.present for dataset in self._datasets])

    @cached_property
    def ids(self) -> list[str]:
        return [source for dataset in self._datasets for source in dataset.ids]

    def has(self, member: str) -> NDArray[np.bool_]:
        return np.concatenate([dataset.has(member) for dataset in self._datasets])

    def motion(self, i: int, first: int = 0, end: int | None = None) -> NDArray[np.float32]:
        dataset, own = self._find(i)
        return dataset.motion(own, first, end)

    def meta(self, i: int) -> ClipMeta:
        dataset, own = self._find(i)
        return dataset.meta(own)

    def texts(self, i: int) -> list[Caption]:
        dataset, own = self._find(i)
        return dataset.texts(own)

    def face_texts(self, i: int) -> list[Caption]:
        dataset, own = self._find(i)
        return dataset.face_texts(own)

    def array(self, i: int, member: str) -> NDArray[np.float32] | None:
        dataset, own = self._find(i)
        return dataset.array(own, member)

    def wav(self, i: int) -> tuple[NDArray[np.float32], int] | None:
        dataset, own = self._find(i)
        return dataset.wav(own)

    def sources(self, clips: NDArray[np.int64] | None = None) -> tuple[Source, ...]:
        """One source for each data set that has any of `clips`; the others' weight goes to those."""
        chosen = np.arange(len(self)) if clips is None else clips
        sources = []
        for (dataset, weight), (_, begin, end) in zip(self._parts, self._ranges(), strict=True):
            first, last = np.searchsorted(chosen, [begin, end]).tolist()
            if last > first:
                own = dataset.sources(chosen[first:last] - begin)
                if len(own) > 1:
                    raise UserError(f"{dataset.where}: a mix of mixes; list all data sets in one mix")
                sources.append(replace(own[0], first=first, weight=weight))
        return tuple(sources)

    def fetch(self, clips: NDArray[np.int64]) -> None:
        for dataset, begin, end in self._ranges():
            dataset.fetch(clips[(clips >= begin) & (clips < end)] - begin)

    def parts(self) -> list[tuple[ClipDataset, float]]:
        return self._parts

    def _ranges(self) -> list[tuple[ClipDataset, int, int]]:
        return list(zip(self._datasets, self._first, self._first[1:], strict=False))

    def _find(self, i: int) -> tuple[ClipDataset, int]:
        if not 0 <= i < len(self):
            raise IndexError(f"clip {i} of {len(self)}")
        part = bisect_right(self._first, i) - 1
        return self._datasets[part], i - self._first[part]
