"""Light on the figure and its shadow, the same in film and pictures as the page's programs have it.

One lamp from above, a sky that is brighter than the ground, a little light from where the camera stands, and
a darker rim. The shadow lies flat on the ground: soft everywhere, and darker where what casts it is near.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.pipeline.render.camera import FIELD_OF_VIEW, Camera
from motionloom.pipeline.render.raster import cover

Floats = NDArray[np.float64]

LAMP = np.array([-0.25, 1.4, 0.55]) / np.linalg.norm([-0.25, 1.4, 0.55])
"""From which side light comes, in the world."""
_SLOPE = LAMP[[0, 2]] / LAMP[1]
_SPREAD = 0.11
"""Metres over which the shadow's rim is soft."""
_TILE = 128
_TINT = np.array([28.0, 34.0, 54.0])
_COOL, _WARM = np.array([0.86, 0.9, 1.0], np.float32), np.array([1.03, 1.0, 0.95], np.float32)
_RIM = np.array([0.1, 0.12, 0.16], np.float32)


def lit(
    base: NDArray[np.float32],
    normals: NDArray[np.float32],
    toward: NDArray[np.float32],
    painted: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Colours [P, 3] from 0 to 1 of surfaces of `base` colour [P, 3] with unit `normals` [P, 3].

    `toward` [P, 3] points to the eye; what is `painted` [P] on the face is darkened by half as much.
    """
    lamp = LAMP.astype(np.float32)
    facing = np.maximum(np.einsum("pi,pi->p", normals, toward), 0)
    key = np.maximum((normals @ lamp + 0.2) / 1.2, 0)
    sky = 0.5 + 0.5 * normals[:, 1]
    light = 0.48 + 0.16 * sky + 0.46 * key + 0.12 * facing
    light = np.where(painted, 0.5 + 0.5 * light, light)
    half = toward + lamp
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    gloss = np.maximum(np.einsum("pi,pi->p", normals, half), 0) ** 28 * np.where(
        painted, np.float32(0.05), np.float32(0.1)
    )
    warm = np.clip(key + 0.25, 0, 1)[:, None]
    out = base * (_COOL + warm * (_WARM - _COOL)) * light[:, None]
    rim = 0.6 * (1 - facing[:, None]) ** 3
    out += rim * (0.72 * out + _RIM * sky[:, None] - out) + gloss[:, None]
    return np.asarray(np.minimum(out, 1.0), dtype=np.float32)


def cast_shadow(
    image: NDArray[np.uint8],
    camera: Camera,
    target: NDArray[Any],
    level: float,
    vertices: Floats,
    triangles: NDArray[np.int64],
) -> None:
    """Darken `image` [H, W, 3], which shows the ground at height `level`, where the figure's shadow falls."""
    height = np.maximum(vertices[:, 1] - level, 0)
    flat = vertices[:, [0, 2]] - height[:, None] * _SLOPE
    low, high = flat.min(axis=0) - 2 * _SPREAD, flat.max(axis=0) + 2 * _SPREAD
    corners = np.array([[x, level, z] for x in (low[0], high[0]) for z in (low[1], high[1])])
    seen = camera.project(corners, target)
    if camera.axes[2, 1] <= 0 or seen[:, 2].min() <= 0.2:
        return  # from below, or so near that the ground goes behind the camera
    dark = _dark(flat, height, triangles, low, high)
    start = np.clip(np.floor(seen[:, :2].min(axis=0)), 0, [image.shape[1], image.shape[0]]).astype(int)
    end = np.clip(np.ceil(seen[:, :2].max(axis=0)), 0, [image.shape[1], image.shape[0]]).astype(int)
    if (end <= start).any():
        return
    x, z = _on_ground(camera, np.asarray(target, np.float64), level, start, end)
    column = (x - low[0]) / (high[0] - low[0]) * _TILE - 0.5
    line = (z - low[1]) / (high[1] - low[1]) * _TILE - 0.5
    from scipy.ndimage import map_coordinates

    shade = map_coordinates(dark, [line, column], order=1, mode="constant")[..., None]
    box = image[start[1] : end[1], start[0] : end[0]]
    box[:] = np.round(box * (1 - shade) + _TINT * shade)


def _dark(flat: Floats, height: Floats, triangles: NDArray[np.int64], low: Floats, high: Floats) -> Floats:
    """How dark the ground is [128, 128] between its corners `low` and `high`."""
    from scipy.ndimage import gaussian_filter

    nearness = np.clip(1 - height / 0.5, 0, 1)
    places = (flat - low) / (high - low) * _TILE
    found = cover(places, nearness, triangles, (_TILE, _TILE), both_sides=True)
    wide, close = np.zeros(_TILE * _TILE), np.zeros(_TILE * _TILE)
    wide[found.pixels] = 1.0
    close[found.pixels] = np.einsum("pk,pk->p", found.shares, nearness[triangles[found.triangles]])
    sigma = 0.5 * _SPREAD * _TILE / (high - low)[::-1]
    shape = (_TILE, _TILE)
    out = 0.2 * gaussian_filter(wide.reshape(shape), sigma)
    return np.asarray(out + 0.3 * gaussian_filter(close.reshape(shape), 0.4 * sigma) ** 1.5)


def _on_ground(
    camera: Camera, target: Floats, level: float, start: NDArray[Any], end: NDArray[Any]
) -> tuple[Floats, Floats]:
    """Where on the ground the pixels between `start` and `end` look: x and z [H, W]; far away above it."""
    right, up, back = camera.axes
    focal = camera.height / 2 / np.tan(FIELD_OF_VIEW / 2)
    across = (np.arange(start[0], end[0]) + 0.5 - camera.width / 2) / focal
    upward = (camera.height / 2 - np.arange(start[1], end[1]) - 0.5) / focal
    eye = target + camera.distance * back
    fall = -(upward * up[1] - back[1])  # of a ray, for each metre of depth; `right` is level
    reach = np.where(fall > 1e-6, (eye[1] - level) / np.maximum(fall, 1e-6), 1e6)[:, None]
    x = eye[0] + reach * (across * right[0] + (upward * up[0] - back[0])[:, None])
    z = eye[2] + reach * (across * right[2] + (upward * up[2] - back[2])[:, None])
    return x, z
