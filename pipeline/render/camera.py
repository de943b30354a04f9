"""The camera of films and pictures; the same lens and default view as the viewer's script."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FIELD_OF_VIEW = 0.5
NEAR = 0.15
VIEWS = {"3/4": (0.62, 0.2), "front": (0.0, 0.08), "side": (np.pi / 2, 0.08), "top": (0.62, 1.35)}


@dataclass(frozen=True)
class Camera:
    """Looks from heading `yaw` (0 = from +Z) and height angle `pitch` at a target, `distance` metres away."""

    yaw: float
    pitch: float
    distance: float
    width: int
    height: int

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """Rows right, up and back [3, 3]."""
        cos_pitch = np.cos(self.pitch)
        back = np.array([np.sin(self.yaw) * cos_pitch, np.sin(self.pitch), np.cos(self.yaw) * cos_pitch])
        right = np.array([np.cos(self.yaw), 0.0, -np.sin(self.yaw)])
        return np.stack([right, np.cross(back, right), back])

    def project(self, points: NDArray[np.floating], target: NDArray[np.floating]) -> NDArray[np.float64]:
        """Points [..., 3] (metres) to [..., 4]: x and y in pixels, depth in metres, pixels per metre."""
        seen = (np.asarray(points, np.float64) - target) @ self.axes.T
        depth = self.distance - seen[..., 2]
        scale = self.height / 2 / np.tan(FIELD_OF_VIEW / 2) / np.maximum(depth, NEAR)
        x = self.width / 2 + seen[..., 0] * scale
        y = self.height / 2 - seen[..., 1] * scale
        return np.stack([x, y, depth, scale], axis=-1)


def fit_distance(height: float, radius: float, width: int, tall: int) -> float:
    """Distance from which a figure of this height and radius (metres) fills a `width` x `tall` picture."""
    tan = np.tan(FIELD_OF_VIEW / 2)
    up, across = max(height * 0.58, radius * 1.05), radius * 1.08
    return float(max(up / tan, across * tall / (tan * width)) + radius * 0.3)


def smooth_path(root: NDArray[np.floating], fps: float, seconds: float = 0.8) -> NDArray[np.float64]:
    """Root positions [T, 3] averaged over about `seconds`, ends repeated: what a camera follows."""
    from scipy.ndimage import uniform_filter1d

    window = 2 * max(1, round(fps * seconds / 2)) + 1
    return np.asarray(uniform_filter1d(np.asarray(root, np.float64), window, axis=0, mode="nearest"))


def floor_of(joints: NDArray[np.floating]) -> float:
    """Ground height, metres: 0 for clips that stand near 0, else the lowest joint."""
    lowest = float(np.min(joints[..., 1]))
    return 0.0 if abs(lowest) < 0.5 else lowest
