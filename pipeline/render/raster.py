"""Triangles into pixels, in numpy: which triangle is in front at each pixel; and the ground under the figure.

Everything is drawn at twice the size and halved: that smooths edges. A figure's triangles are small, so all
pixels of all their boxes are tested in one go, and the nearest of those inside is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from motionloom.pipeline.render.body.palette import Colour
from motionloom.pipeline.render.camera import NEAR, Camera

SOLE = 0.03
"""Metres from the foot joints down to the soles."""
SKY: Colour = (244, 246, 250)
GRID: Colour = (190, 199, 214)
TRAIL: Colour = (122, 91, 208)


@dataclass(frozen=True)
class Cover:
    """What is seen at P pixels."""

    pixels: NDArray[np.int64]
    """[P], counted along rows."""
    triangles: NDArray[np.int64]
    """[P]: the triangle in front."""
    shares: NDArray[np.float64]
    """Of its three corners at the pixel's middle [P, 3]."""


def cover(
    points: NDArray[np.float64],
    nearness: NDArray[np.float64],
    triangles: NDArray[np.int64],
    size: tuple[int, int],
    *,
    both_sides: bool = False,
) -> Cover:
    """Pixels of a picture of `size` (width, height) that triangles [F, 3] cover.

    `points` [V, 2] are in pixels, y down; `nearness` [V] is what a nearer point has more of, linear on the
    screen (1 / depth is). Triangles that are clockwise seen from outside are left out, unless `both_sides`.
    """
    width, height = size
    corners = points[triangles]
    (ax, ay), (bx, by), (cx, cy) = (corners[:, k].T for k in range(3))
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    low = np.maximum(np.ceil(corners.min(axis=1) - 0.5), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) - 0.5), [width - 1, height - 1]).astype(np.int64)
    wide, tall = np.maximum(high - low + 1, 0).T
    seen = np.abs(area) > 1e-9 if both_sides else area < -1e-9
    some = np.flatnonzero(seen & (wide > 0) & (tall > 0))
    counts = wide[some] * tall[some]
    row = np.repeat(np.arange(len(some)), counts)
    number = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    across = wide[some][row]
    down = number // across
    x = low[some, 0][row] + (number - down * across)
    y = low[some, 1][row] + down
    # Shares of the second and third corner are linear on the screen: one multiplication an axis.
    ax, ay, bx, by, cx, cy, area = (values[some] for values in (ax, ay, bx, by, cx, cy, area))
    second = _plane((cy - ay) / area, -(cx - ax) / area, ax, ay, row, x, y)
    third = _plane(-(by - ay) / area, (bx - ax) / area, ax, ay, row, x, y)
    inside = np.flatnonzero((second >= 0) & (third >= 0) & (second + third <= 1))
    row, second, third = row[inside], second[inside], third[inside]
    pixels = y[inside] * width + x[inside]
    near = nearness[triangles[some]]
    depth = near[row, 0] + second * (near[row, 1] - near[row, 0]) + third * (near[row, 2] - near[row, 0])
    front = np.full(width * height, -np.inf)
    np.maximum.at(front, pixels, depth)
    best = np.flatnonzero(depth == front[pixels])
    pixels, first = np.unique(pixels[best], return_index=True)
    best = best[first]
    shares = np.stack([1 - second[best] - third[best], second[best], third[best]], axis=1)
    return Cover(pixels, some[row[best]], shares)


def _plane(
    slope_x: NDArray[np.float64],
    slope_y: NDArray[np.float64],
    at_x: NDArray[np.float64],
    at_y: NDArray[np.float64],
    row: NDArray[np.int64],
    x: NDArray[np.int64],
    y: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Values at the pixels' middles of planes that are 0 at (at_x, at_y)."""
    start = slope_x * (0.5 - at_x) + slope_y * (0.5 - at_y)
    out: NDArray[np.float64] = start[row] + slope_x[row] * x + slope_y[row] * y
    return out


def draw_ground(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    target: NDArray[np.float64],
    floor: float,
    path: NDArray[Any] | None = None,
    reach: float = 3.0,
) -> None:
    """Paint half-metre squares that fade away from the target, and the root's `path` [T, 3] on the ground."""
    y = floor - SOLE
    centre = target[[0, 2]]
    x_ticks, z_ticks = (
        np.arange(np.ceil((c - reach) * 2), np.floor((c + reach) * 2) + 1) / 2 for c in centre
    )
    starts = [(u, centre[1] - reach) for u in x_ticks] + [(centre[0] - reach, v) for v in z_ticks]
    ends = [(u, centre[1] + reach) for u in x_ticks] + [(centre[0] + reach, v) for v in z_ticks]
    share = np.linspace(0, 1, 13)[:, None]
    flat = np.array(starts)[:, None] * (1 - share) + np.array(ends)[:, None] * share
    points = np.insert(flat, 1, y, axis=-1)
    screen = camera.project(points, target)
    middle = (flat[:, 1:] + flat[:, :-1]) / 2
    fades = 1 - np.linalg.norm(middle - centre, axis=-1) / reach
    seen = (fades > 0.03) & (np.minimum(screen[:, 1:, 2], screen[:, :-1, 2]) > NEAR)
    segments = np.concatenate([screen[:, :-1, :2], screen[:, 1:, :2]], axis=-1)[seen]
    for segment, fade in zip(segments.tolist(), fades[seen].tolist(), strict=True):
        draw.line(segment, fill=_mix(SKY, GRID, round(fade, 2)), width=2)
    if path is not None and len(path) > 1:
        ground = np.array(path, np.float64)
        ground[:, 1] = y
        trail = camera.project(ground, target)
        trail = trail[trail[:, 2] > NEAR]
        draw.line(trail[:, :2].ravel().tolist(), fill=_mix(SKY, TRAIL, 0.55), width=5)


@lru_cache(maxsize=1024)
def _mix(a: Colour, b: Colour, share: float) -> Colour:
    red, green, blue = (round(x + (y - x) * share) for x, y in zip(a, b, strict=True))
    return red, green, blue


def halve(image: Image.Image) -> Image.Image:
    """Average 2x2 blocks: the anti-aliasing step."""
    return image.reduce(2)
