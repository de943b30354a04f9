"""Which clips a batch is made of, said without reading their motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class BatchRow(NamedTuple):
    """A row of a training batch."""

    clip: str
    """Its id."""
    first: int
    """First frame; of a token sequence, first group of tokens."""
    length: int
    """Frames, or groups."""


def listed(
    ids: Sequence[str], clips: NDArray[np.int64], first: NDArray[np.int64], length: NDArray[np.int64]
) -> list[BatchRow]:
    """Rows of a batch; all but `ids` are [B]."""
    rows = zip(clips.tolist(), first.tolist(), length.tolist(), strict=True)
    return [BatchRow(ids[clip], begin, count) for clip, begin, count in rows]
