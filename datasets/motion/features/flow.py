"""`JointFlow`: joints of a motion whose columns arrive chunk by chunk.

The root's heading and place are sums over all frames before. They are carried from chunk to chunk and added
in the same order, so the joints are, to the bit, those of `joints_of` over the whole motion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.features.exact import place
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError


class JointFlow:
    """Puts chunk after chunk of one motion into the world.

    Args:
        layout: Layout of whole frames; the columns may also be those of body and hands alone.
    """

    def __init__(self, layout: MotionLayout) -> None:
        self.layout, self._body = layout, layout.without_face() if layout.family != "raw" else layout
        self._angle, self._turning = 0.0, 0.0
        """Sum of the turns before the last frame, and the turn that followed it."""
        self._root, self._going = 0j, 0j
        """The same of the root's way, z + i x; of `h3d` the step is not turned yet."""

    def __call__(self, features: NDArray[np.floating]) -> NDArray[np.float64]:
        """The next columns [T, D] in their own units -> joints [T, N, 3] in metres."""
        if not len(features):
            return np.zeros((0, self.layout.num_joints, 3))
        if self.layout.family == "raw":
            return joints_of(features, self.layout)  # raw parameters say where each frame stands
        columns = self.layout.part("bodyhand")
        if features.ndim != 2 or features.shape[-1] not in (self.layout.dim, len(columns)):
            raise UserError(
                f"layout {self.layout.name} has {self.layout.dim} columns, but these features are "
                f"{list(features.shape)}"
            )
        body = features if features.shape[-1] == len(columns) else features[:, columns]
        yaw = np.asarray(body[:, self._body.slice("root_yaw_velocity")][:, 0], dtype=np.float64)
        published = self.layout.family == "h3d"
        angle = _carried(self._angle, self._turning, yaw)
        turn = np.exp((-2j if published else 1j) * angle)
        xz = body[:, self._body.slice("root_xz_velocity")]
        if published:  # a step is seen from the heading of the frame that it leads to
            own = xz[:, 1] + 1j * xz[:, 0]
            steps = np.concatenate([[self._going], own[:-1]]) * turn
            root = self._root + 0j
            way = np.cumsum(np.concatenate([[root + steps[0]], steps[1:]]))
            self._going = own[-1]
        else:
            own = (np.asarray(xz[:, 1], np.float64) + 1j * np.asarray(xz[:, 0], np.float64)) * turn
            way = _carried(self._root, self._going, own)
            self._going = own[-1]
        self._angle, self._turning, self._root = angle[-1], yaw[-1], way[-1]
        return place(body, self._body, turn, way)


def _carried(
    before: complex | np.floating, step: complex | np.floating, steps: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Sum of the steps before each frame, going on from `before`, the sum at the frame before, by `step`."""
    return np.cumsum(np.concatenate([[before + step], steps[:-1]]))
