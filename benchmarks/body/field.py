"""Implicit shapes: tapered capsules, melted into one surface, and what the surface owes to each of them.

A field is a list of capsules between two points with a radius at each end; `flat` squeezes one along z, which
makes trunks out of tubes. The surface is where the smooth minimum of their distances is 0:
`-k log sum exp(-d / k)`, so shapes nearer than a few `k` (metres) flow into each other. Metres throughout.

A mesh is made from a field on a grid by naive surface nets: every cell whose corners differ in sign gets one
vertex, every grid edge that crosses the surface one quad between the four cells around it. Quads are split in
two; the vertices are then evened out and moved onto the exact surface by the field's own gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Triangles = NDArray[np.int64]
Point = tuple[float, float, float] | NDArray[np.float64]

_REACH = 8.0
"""A shape farther away than so many `k` adds nothing that a float would keep."""


@dataclass(frozen=True)
class Capsule:
    """A rounded, tapered tube that moves with joint `joint`."""

    joint: int
    a: Point
    b: Point
    ra: float
    rb: float
    flat: float = 1.0
    """Depth (z) as a share of the width."""


@dataclass(frozen=True)
class Field:
    """Capsules melted together over about `k` metres."""

    capsules: Sequence[Capsule]
    k: float

    @cached_property
    def joints(self) -> NDArray[np.int64]:
        """Joint [P] of every capsule."""
        return np.array([c.joint for c in self.capsules])

    def distances(self, points: Floats) -> Floats:
        """Distance to every capsule, negative inside: [M, 3] -> [M, P]."""
        return np.stack([_distance(c, points)[0] for c in self.capsules], axis=-1)

    def value(self, points: Floats) -> Floats:
        """The smooth minimum [M] at points [M, 3]."""
        distances = self.distances(points)
        least = distances.min(axis=-1)
        share = np.exp((least[:, None] - distances) / self.k).sum(axis=-1)
        return np.asarray(least - self.k * np.log(share), dtype=np.float64)

    def normals(self, points: Floats) -> Floats:
        """Unit gradients [M, 3]: outward on the surface."""
        slope = self._both(points)[1]
        size = np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)
        return np.asarray(slope / size, dtype=np.float64)

    def onto(self, points: Floats, steps: int = 3) -> Floats:
        """Points [M, 3] near the surface moved onto it along the gradient."""
        for _ in range(steps):
            value, slope = self._both(points)
            square = np.maximum(np.square(slope).sum(axis=-1), 1e-6)
            points = points - (value / square)[:, None] * slope
        return points

    def grid(self, spacing: float) -> tuple[NDArray[np.float64], Floats]:
        """Values on a regular grid around all shapes [X, Y, Z], and the grid's first point.

        Each shape is only evaluated in a box around itself.
        """
        pad = 2 * spacing
        boxes = [_box(capsule) for capsule in self.capsules]
        low = np.min([box[0] for box in boxes], axis=0) - pad
        high = np.max([box[1] for box in boxes], axis=0) + pad
        axes = [np.arange(low[i], high[i] + spacing, spacing) for i in range(3)]
        total = np.zeros([len(axis) for axis in axes])
        reach = _REACH * self.k + 2 * spacing
        for capsule, (near, far) in zip(self.capsules, boxes, strict=True):
            ends = near - reach, far + reach
            box = tuple(slice(*np.searchsorted(a, [e[i] for e in ends])) for i, a in enumerate(axes))
            points = np.stack(np.meshgrid(*(a[s] for a, s in zip(axes, box, strict=True)), indexing="ij"), -1)
            away = np.clip(_distance(capsule, points.reshape(-1, 3))[0] / self.k, -300, 300)
            total[box] += np.exp(-away).reshape(points.shape[:-1])
        return -self.k * np.log(np.maximum(total, 1e-300)), low

    def _both(self, points: Floats) -> tuple[Floats, Floats]:
        """Value [M] and its exact gradient [M, 3]: the shapes' own, each by its share of the minimum."""
        pairs = [_distance(c, points, slope=True) for c in self.capsules]
        distances = np.stack([distance for distance, _ in pairs], axis=-1)
        least = distances.min(axis=-1)
        share = np.exp((least[:, None] - distances) / self.k)
        total = share.sum(axis=-1)
        share /= total[:, None]
        slope = sum(share[:, [i]] * one for i, (_, one) in enumerate(pairs))
        return least - self.k * np.log(total), np.asarray(slope, dtype=np.float64)


def _box(capsule: Capsule) -> tuple[Floats, Floats]:
    """Opposite corners of a box around a capsule; deeper ones than round reach farther along z."""
    ends = np.array([capsule.a, capsule.b], dtype=np.float64)
    around = np.array([capsule.ra, capsule.rb])[:, None] * [1.0, 1.0, max(capsule.flat, 1.0)]
    return (ends - around).min(axis=0), (ends + around).max(axis=0)


def _distance(capsule: Capsule, points: Floats, slope: bool = False) -> tuple[Floats, Floats]:
    """Distance [M] of points [M, 3] to a capsule, and where asked for its gradient [M, 3]."""
    squeeze = np.array([1.0, 1.0, 1.0 / capsule.flat])
    a = np.asarray(capsule.a, dtype=np.float64)
    bone = (np.asarray(capsule.b, dtype=np.float64) - a) * squeeze
    square = max(float(bone @ bone), 1e-12)
    from_a = (points - a) * squeeze
    free = from_a @ bone / square
    along = np.clip(free, 0.0, 1.0)
    from_axis = from_a - along[:, None] * bone
    length = np.sqrt(np.einsum("ij,ij->i", from_axis, from_axis))
    taper = capsule.rb - capsule.ra
    away = length - capsule.ra - along * taper
    if not slope:
        return away, from_axis
    out = from_axis / np.maximum(length, 1e-12)[:, None]
    out[free == along] -= taper / square * bone
    return away, out * squeeze


def skin_weights(
    field: Field, points: Floats, parents: Sequence[int], softness: float | Floats
) -> NDArray[np.float64]:
    """How much each vertex [M] follows each joint: [M, N], rows sum to 1, at most 4 joints a row.

    A joint counts by the distance to its shapes, falling off over `softness` metres, one or [M]; but only
    joints within two steps of the nearest one along the tree, up or down: the other leg and the next finger
    never count.
    """
    count = len(parents)
    distances = field.distances(points)
    nearest = np.full((len(points), count), np.inf)
    for column, joint in enumerate(field.joints):
        nearest[:, joint] = np.minimum(nearest[:, joint], distances[:, column])
    allowed = _kin(parents)[nearest.argmin(axis=1)]
    away = np.maximum(nearest - nearest.min(axis=1, keepdims=True), 0)
    fall = np.exp(-away / np.reshape(softness, (-1, 1)))
    weights = np.where(allowed, fall, 0.0)
    order = np.argsort(weights, axis=1)
    np.put_along_axis(weights, order[:, :-4], 0.0, axis=1)
    weights[weights < 0.02 * weights.max(axis=1, keepdims=True)] = 0.0
    out: NDArray[np.float64] = weights / weights.sum(axis=1, keepdims=True)
    return out


def _kin(parents: Sequence[int]) -> NDArray[np.bool_]:
    """Which joints [N, N] are the same, or one or two steps above or below on one line of descent."""
    count = len(parents)
    out = np.eye(count, dtype=bool)
    for joint in range(count):
        above: Any = joint
        for _ in range(2):
            above = parents[above]
            if above < 0:
                break
            out[joint, above] = out[above, joint] = True
    return out


def mesh_of(field: Field, spacing: float) -> tuple[Floats, Triangles]:
    """Vertices [V, 3] on the field's surface and triangles [F, 3], counter-clockwise seen from outside."""
    values, low = field.grid(spacing)
    points, triangles = surface_nets(values)
    vertices = low + spacing * points
    neighbours = _neighbours(triangles, len(vertices))
    for _ in range(4):
        vertices = field.onto(0.5 * vertices + 0.5 * _mean_of(vertices, neighbours), 1)
    return field.onto(vertices), triangles


def surface_nets(values: Floats) -> tuple[Floats, Triangles]:
    """Vertices [V, 3] in grid steps and triangles [F, 3] around the values [X, Y, Z] below 0.

    The surface must not touch the grid's border.
    """
    inside = values < 0
    corners = [inside[x : inside.shape[0] - 1 + x, y : inside.shape[1] - 1 + y, z : inside.shape[2] - 1 + z]
               for x in (0, 1) for y in (0, 1) for z in (0, 1)]  # fmt: skip
    mixed = np.any(corners, axis=0) & ~np.all(corners, axis=0)
    number = np.full(mixed.shape, -1, dtype=np.int64)
    number[mixed] = np.arange(mixed.sum())
    cells = np.argwhere(mixed)
    total = np.zeros((len(cells), 3))
    crossings = np.zeros(len(cells))
    quads = []
    for axis in range(3):
        near = np.take(values, range(values.shape[axis] - 1), axis)
        far = np.take(values, range(1, values.shape[axis]), axis)
        crossed = (near < 0) != (far < 0)
        at = np.argwhere(crossed)
        share = near[crossed] / (near[crossed] - far[crossed])
        place = at.astype(np.float64)
        place[:, axis] += share
        one = (axis + 1) % 3
        two = (axis + 2) % 3
        around = []
        for step_one, step_two in ((0, 0), (1, 0), (1, 1), (0, 1)):
            cell = at.copy()
            cell[:, one] -= step_one
            cell[:, two] -= step_two
            row = number[tuple(cell.T)]
            around.append(row)
            np.add.at(total, row, place)
            np.add.at(crossings, row, 1)
        quad = np.stack(around, axis=1)
        outward = near[crossed] < 0
        quads.append(np.where(outward[:, None], quad, quad[:, ::-1]))
    quad = np.concatenate(quads)
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return total / crossings[:, None], triangles


def normals_of(vertices: Floats, triangles: Triangles, otherwise: Floats) -> Floats:
    """Unit normals [V, 3] by the triangles around each vertex; `otherwise` where these have no area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    out = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(out, triangles[:, k], np.cross(b - a, c - a))
    size = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(size > 1e-9, out / np.maximum(size, 1e-9), otherwise)


def _neighbours(triangles: Triangles, count: int) -> tuple[Triangles, NDArray[np.float64]]:
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    degree = np.bincount(edges[:, 0], minlength=count).astype(np.float64)
    return edges, np.maximum(degree, 1.0)


def _mean_of(vertices: Floats, neighbours: tuple[Triangles, NDArray[np.float64]]) -> Floats:
    edges, degree = neighbours
    total = np.zeros_like(vertices)
    np.add.at(total, edges[:, 0], vertices[edges[:, 1]])
    return total / degree[:, None]
