"""Draws one pose as an anti-aliased picture with Pillow: the viewer's figure in flat, cel-like shading.

Everything is drawn at twice the size and halved, which costs less than drawing smooth edges. A limb is a nest
of shapes: dark rim, body colour, and ever narrower lights towards the lamp. All outlines of a pose come from
one array operation, because a picture has about 200 of them and a film hundreds of pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from motionloom.pipeline.render.camera import NEAR, Camera
from motionloom.pipeline.render.figure import CENTRE, SKIN, Figure

Colour = tuple[int, int, int]
SOLE = 0.03
# Metres nearer than its middle: a limb must stand out so far to hide the trunk; the neck goes under the chin.
BIAS = {CENTRE: 0.05, SKIN: -0.06}
PALETTE: dict[int, Colour] = {0: (119, 130, 154), 1: (47, 143, 196), 2: (229, 121, 63), 3: (237, 199, 163)}
HAIR: Colour = (90, 68, 54)
EYE: Colour = (36, 29, 27)
LIP: Colour = (168, 69, 63)
INK: Colour = (14, 16, 34)
WHITE: Colour = (255, 255, 255)
SKY: Colour = (244, 246, 250)
SHADOW: Colour = (212, 217, 227)
GRID: Colour = (190, 199, 214)
TRAIL: Colour = (122, 91, 208)
LAMP = np.array([-0.55, -0.83])
# Lights inside a limb: how far they move to the lamp, how wide they are (both in radii), how white.
LIGHTS = ((0.16, 0.74, 0.1), (0.28, 0.5, 0.2), (0.36, 0.26, 0.3))
HEAD_SIZE = np.array([0.083, 0.118, 0.098])
HAIR_SIZE = np.array([0.087, 0.1, 0.094])

_TURN = np.linspace(0, 2 * np.pi, 40, endpoint=False)
_ROUND = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)


@dataclass(frozen=True)
class Pose:
    """One frame: nodes [M, 3], the camera's target [3], the ground's height, the factor on radii."""

    nodes: NDArray[np.float64]
    target: NDArray[np.float64]
    floor: float
    scale: float


@dataclass(frozen=True)
class _Shapes:
    """Capsules and hulls as equal rows: nodes [P, K] and radii [P, K], short rows padded by repeats."""

    nodes: NDArray[np.int64]
    radii: NDArray[np.float64]
    sides: list[int]
    coarse: NDArray[np.bool_]


@lru_cache(maxsize=16)
def _shapes(figure: Figure) -> _Shapes:
    rows = [((c.a, c.b), (c.ra, c.rb), c.side, c.fine) for c in figure.capsules]
    rows += [(h.nodes, h.radii, h.side, False) for h in figure.hulls]  # type: ignore[misc]
    widest = max(len(nodes) for nodes, *_ in rows)
    fill = [widest - len(nodes) for nodes, *_ in rows]
    return _Shapes(
        np.array([(*row[0], *row[0][:1] * pad) for row, pad in zip(rows, fill, strict=True)]),
        np.array([(*row[1], *row[1][:1] * pad) for row, pad in zip(rows, fill, strict=True)]),
        [row[2] for row in rows],
        np.array([not row[3] for row in rows]),
    )


def outlines(centres: NDArray[np.float64], radii: NDArray[np.float64]) -> NDArray[np.float64]:
    """Outlines [P, 40, 2] of the convex hulls of P sets of K circles, centres [P, K, 2] and radii [P, K].

    In each direction the hull's farthest point lies on the circle whose centre plus radius reaches farthest.
    """
    reach = centres @ _ROUND.T + radii[..., None]
    far = reach.argmax(axis=1)[..., None]
    centre = np.take_along_axis(centres, far, axis=1)
    radius = np.take_along_axis(radii[..., None], far, axis=1)
    rim: NDArray[np.float64] = centre + radius * _ROUND
    return rim


def draw_pose(
    draw: ImageDraw.ImageDraw, camera: Camera, figure: Figure, pose: Pose, at: tuple[int, int] = (0, 0)
) -> None:
    """Paint shadow and figure; `at` moves the whole picture (pixels), for many poses on one sheet."""
    offset = np.array([at[0], at[1], 0.0, 0.0])
    shapes = _shapes(figure)
    screen = camera.project(pose.nodes, pose.target) + offset
    if screen[:, 2].min() < NEAR:
        return  # a figure the camera stands in cannot be painted
    _shadow(draw, camera, shapes, pose, offset)
    centres = screen[shapes.nodes, :2]
    radii = np.maximum(shapes.radii * pose.scale * screen[shapes.nodes, 3], 1.2)
    body = outlines(centres, radii)
    rims = outlines(centres, radii + 1.3)
    lights = [outlines(centres + LAMP * (radii * s)[..., None], radii * r) for s, r, _ in LIGHTS]
    large = radii.max(axis=1) > 7
    rimmed = shapes.coarse | (radii.max(axis=1) > 4)
    depth = screen[shapes.nodes, 2].mean(axis=1)
    bias = np.array([BIAS.get(side, 0.0) for side in shapes.sides])
    order = [(float(-d), k) for k, d in enumerate(depth - bias)]
    if figure.head is not None:
        order.append((-float(screen[figure.head.head, 2]), -1))
    for _, k in sorted(order):
        if k < 0:
            _head(draw, camera, figure, pose, offset)
            continue
        colour = PALETTE[shapes.sides[k]]
        if rimmed[k]:
            _polygon(draw, rims[k], _mix(colour, INK, 0.5))
        _polygon(draw, body[k], colour)
        if large[k]:
            for light, (_, _, white) in zip(lights, LIGHTS, strict=True):
                _polygon(draw, light[k], _mix(colour, WHITE, white))


def draw_ground(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    pose: Pose,
    path: NDArray[Any] | None = None,
    reach: float = 3.0,
) -> None:
    """Paint half-metre squares that fade away from the target, and the root's `path` [T, 3] on the ground."""
    y = pose.floor - SOLE
    centre = pose.target[[0, 2]]
    x_ticks, z_ticks = (
        np.arange(np.ceil((c - reach) * 2), np.floor((c + reach) * 2) + 1) / 2 for c in centre
    )
    starts = [(u, centre[1] - reach) for u in x_ticks] + [(centre[0] - reach, v) for v in z_ticks]
    ends = [(u, centre[1] + reach) for u in x_ticks] + [(centre[0] + reach, v) for v in z_ticks]
    share = np.linspace(0, 1, 13)[:, None]
    flat = np.array(starts)[:, None] * (1 - share) + np.array(ends)[:, None] * share
    points = np.insert(flat, 1, y, axis=-1)
    screen = camera.project(points, pose.target)
    middle = (flat[:, 1:] + flat[:, :-1]) / 2
    fades = 1 - np.linalg.norm(middle - centre, axis=-1) / reach
    seen = (fades > 0.03) & (np.minimum(screen[:, 1:, 2], screen[:, :-1, 2]) > NEAR)
    segments = np.concatenate([screen[:, :-1, :2], screen[:, 1:, :2]], axis=-1)[seen]
    for segment, fade in zip(segments.tolist(), fades[seen].tolist(), strict=True):
        draw.line(segment, fill=_mix(SKY, GRID, round(fade, 2)), width=2)
    if path is not None and len(path) > 1:
        ground = np.array(path, np.float64)
        ground[:, 1] = y
        trail = camera.project(ground, pose.target)
        trail = trail[trail[:, 2] > NEAR]
        draw.line(trail[:, :2].ravel().tolist(), fill=_mix(SKY, TRAIL, 0.55), width=5)


def _shadow(
    draw: ImageDraw.ImageDraw, camera: Camera, shapes: _Shapes, pose: Pose, offset: NDArray[np.float64]
) -> None:
    """The coarse shapes' shadow on the ground, cast by a high lamp."""
    ground = pose.floor - SOLE
    height = np.maximum(pose.nodes[:, 1] - ground, 0.0)
    fallen = np.stack([pose.nodes[:, 0] - 0.22 * height, pose.nodes[:, 2] - 0.16 * height], axis=-1)
    rims = outlines(fallen[shapes.nodes[shapes.coarse]], shapes.radii[shapes.coarse] * pose.scale)
    seen = camera.project(np.insert(rims, 1, ground, axis=-1), pose.target) + offset
    for rim in seen:
        if rim[:, 2].min() > NEAR:
            _polygon(draw, rim[:, :2], SHADOW)


def _head(
    draw: ImageDraw.ImageDraw, camera: Camera, figure: Figure, pose: Pose, offset: NDArray[np.float64]
) -> None:
    """Ellipsoids for skull and hair; eyes and mouth where the face is turned to the camera."""
    head = figure.head
    assert head is not None
    at = pose.nodes
    lean = _unit(at[head.head] - at[head.neck])
    left = _unit(at[head.left] - at[head.right])
    up = _unit(lean - 0.31 * np.cross(left, lean))
    left = _unit(left - (left @ up) * up)
    front = np.cross(left, up)
    axes = np.stack([left, up, front])
    size = HEAD_SIZE * pose.scale
    centre = at[head.head] + up * size[1] * 0.62 + front * size[2] * 0.12
    hair = centre + (up * 0.03 - front * 0.024) * pose.scale
    parts = [(centre, size, PALETTE[SKIN]), (hair, HAIR_SIZE * pose.scale, HAIR)]
    # Seen from the side, the hair lies behind the skull: it needs a lead to be painted over it.
    over = (hair - centre) @ camera.axes[2] > 0.012 * pose.scale
    if not over:
        parts.reverse()
    for middle, half, colour in parts:
        seen = camera.project(middle, pose.target) + offset
        flat = (axes @ camera.axes[:2].T) * half[:, None] * seen[3]
        # An ellipsoid's outline is the unit circle under the square root of its projected spread.
        values, vectors = np.linalg.eigh(flat.T @ flat)
        root = vectors @ np.diag(np.sqrt(np.maximum(values, 1e-6))) @ vectors.T
        ring = (_ROUND @ root) * [1, -1]
        draw.polygon((ring + seen[:2]).ravel().tolist(), fill=colour, outline=_mix(colour, INK, 0.5), width=2)
        for shift, width, white in LIGHTS:
            middle_2d = seen[:2] + LAMP * shift * np.abs(ring).max()
            _polygon(draw, ring * width + middle_2d, _mix(colour, WHITE, white * 0.8))
    _face(draw, camera, pose, offset, centre, axes, size)


def _face(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    pose: Pose,
    offset: NDArray[np.float64],
    centre: NDArray[np.float64],
    axes: NDArray[np.float64],
    size: NDArray[np.float64],
) -> None:
    """Two eyes and a mouth laid on the skull."""
    mouth = [(x, -0.055 + 6 * x * x) for x in np.linspace(-0.028, 0.028, 7)]
    marks = np.zeros((9, 3))
    marks[:, :2] = np.array([(-0.033, 0.004), (0.033, 0.004), *mouth]) * pose.scale
    marks[:, 2] = size[2] * np.sqrt(1 - (marks[:, 0] / size[0]) ** 2 - (marks[:, 1] / size[1]) ** 2)
    points = centre + marks @ axes
    seen = camera.project(points, pose.target) + offset
    eye = camera.axes[2] * camera.distance + pose.target
    facing = [float(_unit((m / size**2) @ axes) @ _unit(eye - p)) for m, p in zip(marks, points, strict=True)]
    for k in range(2):
        if facing[k] > 0.15:
            x, y, _, scale = seen[k]
            r = max(0.012 * pose.scale * scale, 1.5)
            draw.ellipse([x - r, y - r, x + r, y + r], fill=EYE)
    if facing[5] > 0.2:
        draw.line(seen[2:, :2].ravel().tolist(), fill=LIP, width=max(2, int(0.006 * seen[5, 3])))


def _polygon(draw: ImageDraw.ImageDraw, ring: NDArray[np.float64], colour: Colour) -> None:
    draw.polygon(ring.ravel().tolist(), fill=colour)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    out: NDArray[np.float64] = vector / max(float(np.linalg.norm(vector)), 1e-9)
    return out


@lru_cache(maxsize=1024)
def _mix(a: Colour, b: Colour, share: float) -> Colour:
    red, green, blue = (round(x + (y - x) * share) for x, y in zip(a, b, strict=True))
    return red, green, blue


def halve(image: Image.Image) -> Image.Image:
    """Average 2x2 blocks: the anti-aliasing step."""
    return image.reduce(2)
