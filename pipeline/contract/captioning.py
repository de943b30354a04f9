"""The interface of a motion captioner."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout, Part


@dataclass(frozen=True)
class Sentence:
    """A sentence about a motion, with its probability."""

    text: str
    log_probability: float
    """Natural logarithm of the probability of the whole sentence."""

    @property
    def probability(self) -> float:
        return math.exp(self.log_probability)


class MotionCaptioner(Protocol):
    """A trained stage that describes motions in sentences."""

    @property
    def layout(self) -> MotionLayout:
        """The layout of whole frames."""

    @property
    def part(self) -> Part:
        """The part of the layout that it reads."""

    @property
    def min_frames(self) -> int:
        """Frames of the shortest motion that it can read."""

    @property
    def max_frames(self) -> int:
        """Frames of the longest motion that it reads whole; the rest of a longer one is ignored."""

    def reads(self, present: int) -> bool:
        """Whether it can read motions with these parts alone, bits of `ClipMeta.present`."""

    def caption(
        self, motions: Sequence[NDArray[np.float32]], count: int, present: Sequence[int] | None = None
    ) -> list[list[Sentence]]:
        """Return up to `count` sentences for each motion [T, C] in its own units, likeliest first.

        `present` [n] says by the bits of `ClipMeta.present` what each holds; None = all.
        """
