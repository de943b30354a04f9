"""Triangles into pixels, in numpy: which triangle is in front at each pixel, and where in it the pixel lies.

Each triangle becomes one span for each line of pixels that it crosses; all spans of a picture are filled in
one go, and of the pixels at one place the nearest is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Cover:
    """What is seen at P pixels."""

    pixels: NDArray[np.int64]
    """[P], counted along rows, each once."""
    triangles: NDArray[np.int64]
    """The triangle in front [P]."""
    shares: Array
    """Weight of its second and third corner at the pixel's middle [2, P]; the first has what is left of 1."""

    def mixed(self, corners: NDArray[np.int64], values: Array) -> Array:
        """Values [V, C] of the corners [F, 3], mixed at each pixel [P, C]."""
        first, second, third = (np.take(values, corners[:, k], axis=0) for k in range(3))
        slopes = np.concatenate([first, second - first, third - first], axis=1)
        here, wide = np.take(slopes, self.triangles, axis=0), values.shape[1]
        out: Array = here[:, :wide] + self.shares[0][:, None] * here[:, wide : 2 * wide]
        out += self.shares[1][:, None] * here[:, 2 * wide :]
        return out


def cover(
    points: NDArray[np.floating],
    nearness: NDArray[np.floating],
    triangles: NDArray[np.int64],
    size: tuple[int, int],
    *,
    both_sides: bool = False,
) -> Cover:
    """Pixels of a picture of `size` (width, height) that triangles [F, 3] cover.

    `points` [V, 2] are in pixels, y down; `nearness` [V], from 0 to 1, is larger for nearer points and linear
    on the screen (1 / depth is). Triangles that are clockwise from outside are left out, unless `both_sides`.
    """
    width, height = size
    corners = np.ascontiguousarray(triangles.T)
    x, y = (points[:, k].astype(np.float32)[corners] for k in (0, 1))
    area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0])
    top = np.maximum(np.ceil(y.min(axis=0) - 0.5), 0).astype(np.int64)
    lines = np.minimum(np.floor(y.max(axis=0) - 0.5), height - 1).astype(np.int64) + 1 - top
    on_screen = (lines > 0) & (x.max(axis=0) > 0) & (x.min(axis=0) < width)
    some = np.flatnonzero(on_screen & (np.abs(area) > 1e-9 if both_sides else area < -1e-9))
    x, y, area, lines = x[:, some], y[:, some], area[some], lines[some]
    # Spans: one for each triangle and line, from the last edge that enters it to the first that leaves it.
    of = np.repeat(np.arange(len(some)), lines)
    line = np.arange(len(of)) - np.repeat(np.cumsum(lines) - lines - top[some], lines)
    at = line.astype(np.float32) + 0.5
    start, end = np.zeros(len(of), np.float32), np.full(len(of), width, np.float32)
    for k in range(3):
        rise = y[(k + 1) % 3] - y[k]
        slope = (x[(k + 1) % 3] - x[k]) / np.where(rise == 0, 1, rise)
        crossing = (x[k] - y[k] * slope)[of] + at * slope[of]
        enters, leaves = (((rise > 0) != (area > 0)) & (rise != 0))[of], ((rise > 0) == (area > 0))[of]
        np.minimum(end, crossing, out=end, where=leaves)
        np.maximum(start, crossing, out=start, where=enters)
    first = np.ceil(start - 0.5).astype(np.int64)
    counts = np.maximum(np.ceil(end - 0.5).astype(np.int64) - first, 0)
    # Pixels: all of every span. Depth and shares are planes over the screen.
    inverse = 1 / area
    second_x, second_y = (y[2] - y[0]) * inverse, (x[0] - x[2]) * inverse
    third_x, third_y = (y[0] - y[1]) * inverse, (x[1] - x[0]) * inverse
    near = nearness.astype(np.float32)[corners[:, some]]
    rises = near[1] - near[0], near[2] - near[0]
    down, across = at - y[0][of], first.astype(np.float32) + np.float32(0.5) - x[0][of]
    depth_x = (second_x * rises[0] + third_x * rises[1])[of]
    depth = near[0][of] + across * depth_x + down * (second_y * rises[0] + third_y * rises[1])[of]
    number = np.arange(int(counts.sum()))
    column = number - np.repeat(np.cumsum(counts) - counts, counts)
    pixels = column + np.repeat(line * width + first, counts)
    depths = np.repeat(depth, counts) + np.repeat(depth_x, counts) * column.astype(np.float32)
    front = np.full(width * height, -1, np.int64)
    np.maximum.at(front, pixels, depths.view(np.int32).astype(np.int64) << 32 | number)
    seen = np.flatnonzero(front >= 0)
    best = front[seen] & 0xFFFFFFFF
    span = np.repeat(np.arange(len(of)), counts)[best]
    of = of[span]
    across, down = across[span] + column[best].astype(np.float32), down[span]
    slopes = (second_x, second_y), (third_x, third_y)
    shares = np.stack([across * to_right[of] + down * to_below[of] for to_right, to_below in slopes])
    return Cover(seen, some[of], shares)
