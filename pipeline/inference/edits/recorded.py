"""A clip in memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import BODY_JOINTS

LEAST_FRAMES = 4
"""Fewer have no motion in them."""


@dataclass(frozen=True)
class RecordedClip:
    """A clip as it was recorded or made."""

    name: str
    joints: NDArray[np.float64]
    """Metres, Y up: [T, 22, 3], or [T, 52, 3] where it has hands."""
    fps: float
    face: NDArray[np.float32] | None = None
    """Expression [T, 50]."""
    caption: str = ""

    @property
    def has_hands(self) -> bool:
        return int(self.joints.shape[1]) > BODY_JOINTS

    @property
    def seconds(self) -> float:
        return len(self.joints) / self.fps
