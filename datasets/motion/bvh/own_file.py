"""A user's BVH file with what is needed to read its figure, and to write in it (`pipeline/editing`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.bvh.joint_map import JointMap, Up
from motionloom.datasets.motion.bvh.motion import BvhMotion


@dataclass(frozen=True)
class OwnBvh:
    """A BVH file, and how its figure is read."""

    data: bytes
    """Its text, lines ended by LF, without byte order mark."""
    motion: BvhMotion
    joint_map: JointMap
    unit: float
    """Metres in a length of the file."""
    up: Up
    added: int
    """Frames in front that are no motion."""
    mark: bytes = b""
    """Bytes in front of the text: a byte order mark or none."""
    ends: bytes = b"\n"
    """Line end."""

    @property
    def file(self) -> bytes:
        """The bytes of the file."""
        return self.mark + self.data.replace(b"\n", self.ends)

    def places(self) -> NDArray[np.float64]:
        """Positions [R, N, 3] of the mapped joints, in metres and Y up, without the added frames."""
        return self.joint_map.apply(self.motion, unit=self.unit, up=self.up)[self.added :]
