"""A clip that is edited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.layout import BODY_JOINTS


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
    bvh: OwnBvh | None = None
    """The file, where it is a BVH."""
    figure: RigidMotion | None = None
    """The figure whose joints these are, where a file of ours holds it."""

    @property
    def has_hands(self) -> bool:
        return int(self.joints.shape[1]) > BODY_JOINTS

    @property
    def seconds(self) -> float:
        return len(self.joints) / self.fps
