"""`ClipDataset`: the interface of a data set for batches, statistics and stages: a folder, a URL or a mix.

`Source` is what a plan of batches knows of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.records import Caption, ClipMeta, Split
from motionloom.datasets.motion.layout import MotionLayout


@dataclass(frozen=True)
class Source:
    """The items `first .. first + count` of a plan: those of one data set."""

    first: int
    count: int
    weight: float = 1.0
    """Share of the batches, relative to the other sources."""
    shards: NDArray[np.int32] | None = None
    """Shard of each item, [count], for the streamed order; None for the global one."""
    group: int = 1
    """Streams that the streamed order reads side by side, which mixes so many shards. In a mix of data sets,
    the shards whose items are shuffled together."""
    name: str = ""


class ClipDataset(Protocol):
    """The clips of one split, numbered from 0."""

    where: str
    """Folder or URL, for messages."""
    split: Split
    layout: MotionLayout

    def __len__(self) -> int: ...

    @property
    def frames(self) -> NDArray[np.int64]:
        """T of every clip, [n]."""
        ...

    @property
    def present(self) -> NDArray[np.uint8]:
        """Parts beside the body that each clip has, bits of `ClipMeta.present`, [n]."""
        ...

    @property
    def ids(self) -> list[str]:
        """Source id of every clip."""
        ...

    def has(self, member: str) -> NDArray[np.bool_]:
        """Return which clips hold a member such as `texts.json`, [n]."""
        ...

    def motion(self, i: int, first: int = 0, end: int | None = None) -> NDArray[np.float32]:
        """Features of clip `i`, [T, D], or of its frames `first .. end` alone."""
        ...

    def meta(self, i: int) -> ClipMeta: ...

    def texts(self, i: int) -> list[Caption]:
        """Captions of clip `i`."""
        ...

    def face_texts(self, i: int) -> list[Caption]:
        """Captions about the face of clip `i`."""
        ...

    def array(self, i: int, member: str) -> NDArray[np.float32] | None:
        """A modality's features of clip `i`, [L, E], such as `audio.npy`."""
        ...

    def wav(self, i: int) -> tuple[NDArray[np.float32], int] | None:
        """Sound of clip `i`: (mono samples [S], rate in Hz)."""
        ...

    def sources(self, clips: NDArray[np.int64] | None = None) -> tuple[Source, ...]:
        """Return the order and mix of a batch plan over `clips` (ascending numbers; all when None)."""
        ...

    def fetch(self, clips: NDArray[np.int64]) -> None:
        """Begin to bring the shards of clips that will be read soon to this machine, where they are not."""
        ...

    def parts(self) -> Sequence[tuple[ClipDataset, float]]:
        """(data set, weight) of each part of a mix; itself if it is none."""
        ...
