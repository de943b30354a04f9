"""One picture of a film: the ground with its grid, the figure's shadow, and the body in the page's light.

One lamp from above, a sky that is brighter than the ground, a little light from where the camera stands, and
a darker rim. The shadow is soft everywhere, and darker where what casts it is near the ground.

The camera may move along with the figure but never turns, so what a pixel sees of the ground is worked out
once. Light is computed at the vertices and mixed between them; the body is drawn at twice the size and
averaged, which smooths its edges.

Triangles become pixels in numpy: each becomes one span for each line of pixels that it crosses; all spans of
a picture are filled in one go, and of the pixels at one place the nearest is kept (`cover`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import CONTROLS, control_weights
from motionloom.pipeline.render.body.mesh import (
    FIRST_OF_HEAD,
    Body,
    Detail,
    Posing,
    body_for,
    colours,
    posing_of,
)
from motionloom.pipeline.render.camera import FIELD_OF_VIEW, NEAR, Camera

Floats = NDArray[np.float64]
Array = NDArray[np.float32]
Picture = NDArray[np.uint8]

SOLE = 0.03
"""Metres from the foot joints down to the soles."""
SKY, GRID, TRAIL = (np.array(c, np.float32) for c in ((244, 246, 250), (190, 199, 214), (122, 91, 208)))
LAMP = np.array([-0.25, 1.4, 0.55]) / np.linalg.norm([-0.25, 1.4, 0.55])
"""From which side light comes, in the world."""
_SLOPE = LAMP[[0, 2]] / LAMP[1]
_SPREAD = 0.11
"""Metres over which the shadow's rim is soft."""
_TILE = 64
"""Places of the shadow's own picture, each way."""
_TINT = np.array([28.0, 34.0, 54.0], np.float32)
_COOL, _WARM = np.array([0.86, 0.9, 1.0], np.float32), np.array([1.03, 1.0, 0.95], np.float32)
_RIM = np.array([0.1, 0.12, 0.16], np.float32)
_REACH = 3.0
"""Metres of ground with a grid around the camera's target."""
_FINE = 400
"""A figure of so many pixels is drawn with all vertices."""


@dataclass(frozen=True)
class Actor:
    """The body in one motion of T frames."""

    posing: Posing
    face: Floats | None = None
    """Weights [T, 7] of the face's shapes."""
    _bodies: dict[Detail, Body] = field(default_factory=dict)

    @staticmethod
    def of(
        joints: NDArray[np.floating],
        skeleton: Skeleton,
        figure: RigidMotion | None = None,
        face_controls: NDArray[np.floating] | None = None,
    ) -> Actor:
        """`figure` has the rotations of joints [T, N, 3], where they are known; controls are [T, 5]."""
        face = None if face_controls is None else control_weights(face_controls)
        return Actor(posing_of(joints, skeleton, figure), face)

    def body(self, detail: Detail) -> Body:
        """The mesh on this motion's bones; made when it is first asked for."""
        if detail not in self._bodies:
            shapes = () if detail == "shadow" else CONTROLS
            self._bodies[detail] = body_for(self.posing.skeleton, shapes, detail)
        return self._bodies[detail]

    @cached_property
    def _bones(self) -> Floats:
        return self.posing.bones()

    def at(self, frame: int, detail: Detail) -> tuple[Array, Array]:
        """Vertices and normals [V, 3]."""
        face = None if self.face is None or detail == "shadow" else self.face[frame]
        return self.body(detail).skinned(self._bones[frame], self.posing.joints[frame], face)


def lit(body: Body, vertices: Array, normals: Array, eye: Floats) -> Array:
    """Colours [V, 3], 0 to 255, of the vertices as the light and the eye find them."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    toward = eye.astype(np.float32) - vertices
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    lamp = LAMP.astype(np.float32)
    painted = body.swatch > FIRST_OF_HEAD + 1
    facing = np.maximum(np.einsum("vi,vi->v", normals, toward), 0)
    key = np.maximum((normals @ lamp + 0.2) / 1.2, 0)
    sky = 0.5 + 0.5 * normals[:, 1]
    light = 0.48 + 0.16 * sky + 0.46 * key + 0.12 * facing
    # Painted parts of the face keep half of their own colour, or they would vanish in the shade.
    light = np.where(painted, 0.5 + 0.5 * light, light)
    half = toward + lamp
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    gloss = np.maximum(np.einsum("vi,vi->v", normals, half), 0) ** 28
    gloss *= np.where(painted, np.float32(0.05), np.float32(0.1))
    warm = np.clip(key + 0.25, 0, 1)[:, None]
    base = colours()[body.swatch].astype(np.float32) / 255
    out = base * (_COOL + warm * (_WARM - _COOL)) * light[:, None]
    # The rim is darker, so that the figure stands out from a bright ground.
    rim = 0.6 * (1 - facing[:, None]) ** 3
    out += rim * (_RIM * sky[:, None] - 0.28 * out) + gloss[:, None]
    return np.asarray(255 * np.clip(out, 0, 1), dtype=np.float32)


def detail_for(camera: Camera) -> Detail:
    """Return the detail that is fine enough for the camera's picture."""
    height = camera.height * 1.7 / (2 * np.tan(FIELD_OF_VIEW / 2) * camera.distance)
    return "near" if height > _FINE else "far"


def draw_figure(
    image: Picture, camera: Camera, target: Floats, actor: Actor, frame: int, detail: Detail
) -> None:
    """Paint the body onto `image` [H, W, 3] of the camera's size."""
    vertices, normals = actor.at(frame, detail)
    seen = camera.project(vertices, target)
    if seen[:, 2].min() < NEAR:
        return  # a figure the camera stands in cannot be painted
    low = np.maximum(np.floor(seen[:, :2].min(axis=0)) - 1, 0).astype(int)
    high = np.minimum(np.ceil(seen[:, :2].max(axis=0)) + 1, [camera.width, camera.height]).astype(int)
    wide, tall = (high - low).tolist()
    if wide <= 0 or tall <= 0:
        return
    body = actor.body(detail)
    near = NEAR / seen[:, 2]  # 1 / depth is linear on the screen, depth is not
    covered = cover(2 * (seen[:, :2] - low), near, body.triangles, (2 * wide, 2 * tall))
    eye = np.asarray(target, np.float64) + camera.distance * camera.axes[2]
    fine = np.zeros((2 * tall, 2 * wide, 4), np.uint8)
    fine.reshape(-1, 4)[covered.pixels, :3] = covered.mixed(body.triangles, lit(body, vertices, normals, eye))
    fine.reshape(-1, 4)[covered.pixels, 3] = 255
    small = np.asarray(Image.fromarray(fine, "RGBa").reduce(2))
    rows, columns = np.nonzero(small[..., 3])
    rows, columns, small = rows + low[1], columns + low[0], small[rows, columns].astype(np.float32)
    image[rows, columns] = image[rows, columns] * (1 - small[:, 3:] / 255) + small[:, :3]


class Ground:
    """The ground at height `level` as a camera of fixed direction sees it, relative to its target.

    The target moves along the ground, `target_height` metres above 0.
    """

    def __init__(self, camera: Camera, target_height: float, level: float) -> None:
        self.camera, self.level = camera, level
        right, up, back = camera.axes
        focal = camera.height / 2 / np.tan(FIELD_OF_VIEW / 2)
        across = (np.arange(camera.width) + 0.5 - camera.width / 2) / focal
        upward = (camera.height / 2 - np.arange(camera.height) - 0.5) / focal
        eye = camera.distance * back
        fall = back[1] - upward * up[1]  # of a ray, for each metre of depth; `right` is level
        reach = np.where(fall > 1e-6, (eye[1] + target_height - level) / np.maximum(fall, 1e-6), 1e6)[:, None]
        self.x = (eye[0] + reach * (across * right[0] + (upward * up[0] - back[0])[:, None])).astype(
            np.float32
        )
        self.z = (eye[2] + reach * (across * right[2] + (upward * up[2] - back[2])[:, None])).astype(
            np.float32
        )
        away = np.hypot(self.x, self.z)
        rows = np.flatnonzero((away < _REACH).any(axis=1))
        self._rows = slice(int(rows[0]), int(rows[-1]) + 2) if len(rows) else slice(0, 2)
        self._fade = np.clip(1 - away[self._rows] / _REACH, 0, 1).ravel()
        # Half metres of ground a pixel, across each set of lines: they are 1 pixel wide however far they are.
        self._finer = [
            (0.5 / np.maximum(np.hypot(*np.gradient(ground[self._rows])), 1e-6)).ravel()
            for ground in (self.x, self.z)
        ]
        self._empty = np.empty((camera.height, camera.width, 3), np.uint8)
        self._empty[:] = SKY

    def draw(self, target: Floats) -> Picture:
        """Half-metre squares that fade away from the target, on an empty picture."""
        image = self._empty.copy()
        line = np.zeros_like(self._fade)
        for ground, finer, place in zip((self.x, self.z), self._finer, target[[0, 2]], strict=True):
            at = 2 * (ground[self._rows].ravel() + np.float32(place))
            at -= np.rint(at)
            np.maximum(line, 1 - np.abs(at, out=at) * finer, out=line)
        line *= self._fade
        drawn = np.flatnonzero(line > 0.02)
        colour = SKY + line[drawn, None] * (GRID - SKY)
        image[self._rows].reshape(-1, 3)[drawn] = colour.astype(np.uint8)
        return image

    def draw_trail(self, image: Picture, target: Floats, path: NDArray[np.floating]) -> None:
        """The root's way [T, 3] over the ground."""
        ground = np.array(path, np.float64)
        ground[:, 1] = self.level
        seen = self.camera.project(ground, target)
        points = 2 * seen[seen[:, 2] > NEAR, :2]
        size = (2 * self.camera.width, 2 * self.camera.height)
        low = np.clip(points.min(axis=0, initial=np.inf) - 6, 0, size).astype(int) // 2
        high = np.clip(points.max(axis=0, initial=-np.inf) + 6, 0, size).astype(int) // 2
        if (high - low < 1).any():
            return
        mask = Image.new("L", tuple(2 * (high - low)))
        ImageDraw.Draw(mask).line([tuple(p) for p in points - 2 * low], fill=140, width=5, joint="curve")
        share = np.asarray(mask.reduce(2), np.float32)[..., None] / 255
        box = image[low[1] : high[1], low[0] : high[0]]
        box[:] = box + share * (TRAIL - box)

    def cast_shadow(self, image: Picture, target: Floats, actor: Actor, frame: int) -> None:
        """Darken the picture where the figure's shadow falls."""
        from scipy.ndimage import map_coordinates

        vertices = actor.at(frame, "shadow")[0].astype(np.float64)
        height = np.maximum(vertices[:, 1] - self.level, 0)
        flat = vertices[:, [0, 2]] - height[:, None] * _SLOPE
        low, high = flat.min(axis=0) - 2 * _SPREAD, flat.max(axis=0) + 2 * _SPREAD
        corners = np.array([[x, self.level, z] for x in (low[0], high[0]) for z in (low[1], high[1])])
        seen = self.camera.project(corners, target)
        if self.camera.axes[2, 1] <= 0 or seen[:, 2].min() <= 0.2:
            return  # from below, or so near that the ground goes behind the camera
        dark = _darkness(flat, height, actor.body("shadow").triangles, low, high)
        size = [image.shape[1], image.shape[0]]
        start = np.clip(np.floor(seen[:, :2].min(axis=0)), 0, size).astype(int)
        end = np.clip(np.ceil(seen[:, :2].max(axis=0)), 0, size).astype(int)
        if (end <= start).any():
            return
        part = slice(start[1], end[1]), slice(start[0], end[0])
        places = [
            (ground[part] + np.float32(middle - corner)) * np.float32(_TILE / (far - corner))
            - np.float32(0.5)
            for ground, middle, corner, far in (
                (self.z, target[2], low[1], high[1]),
                (self.x, target[0], low[0], high[0]),
            )
        ]
        shade = map_coordinates(dark, places, order=1, mode="constant", output=np.float32)[..., None]
        image[part] = image[part] * (1 - shade) + _TINT * shade + 0.5


def _darkness(flat: Floats, height: Floats, triangles: NDArray[np.int64], low: Floats, high: Floats) -> Array:
    """Darkness of the shadow [64, 64] on the ground between the corners `low` and `high`."""
    from scipy.ndimage import gaussian_filter

    nearness = np.clip(1 - height / 0.5, 0, 1).astype(np.float32)
    places = (flat - low) / (high - low) * _TILE
    covered = cover(places, nearness, triangles, (_TILE, _TILE), both_sides=True)
    wide, close = np.zeros((2, _TILE * _TILE), np.float32)
    wide[covered.pixels] = 1.0
    close[covered.pixels] = covered.mixed(triangles, nearness[:, None])[:, 0]
    sigma = 0.5 * _SPREAD * _TILE / (high - low)[::-1]
    shape = (_TILE, _TILE)
    out = 0.2 * gaussian_filter(wide.reshape(shape), sigma)
    return np.asarray(out + 0.3 * gaussian_filter(close.reshape(shape), 0.4 * sigma) ** 1.5, np.float32)


@dataclass(frozen=True)
class Cover:
    """The triangle in front at each of P pixels."""

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
    # Triangles that face the camera and meet the picture.
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
        # Level edges bound no span.
        enters, leaves = (
            ((sign & (rise != 0))[of]) for sign in ((rise > 0) != (area > 0), (rise > 0) == (area > 0))
        )
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
    # Depth in the high bits and the pixel's number in the low ones: one maximum finds both.
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
