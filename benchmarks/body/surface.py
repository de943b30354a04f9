"""From a field on a grid to a closed mesh: naive surface nets, in numpy.

Every grid cell whose corners differ in sign gets one vertex, every grid edge that crosses the surface one
quad between the four cells around it. Quads are split in two; the vertices are then evened out and moved onto
the exact surface by the field's own gradient.
"""

from __future__ import annotations

import numpy as np
from field import Field
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Triangles = NDArray[np.int64]

_ROUNDS = 4


def mesh_of(field: Field, spacing: float) -> tuple[Floats, Triangles]:
    """Vertices [V, 3] on the field's surface and triangles [F, 3], counter-clockwise seen from outside."""
    values, low = field.grid(spacing)
    points, triangles = surface_nets(values)
    vertices = low + spacing * points
    neighbours = _neighbours(triangles, len(vertices))
    for _ in range(_ROUNDS):
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
    total, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    quads = []
    for axis in range(3):
        near = np.take(values, range(values.shape[axis] - 1), axis)
        far = np.take(values, range(1, values.shape[axis]), axis)
        crossed = (near < 0) != (far < 0)
        at = np.argwhere(crossed)
        share = near[crossed] / (near[crossed] - far[crossed])
        place = at.astype(np.float64)
        place[:, axis] += share
        one, two = (axis + 1) % 3, (axis + 2) % 3
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
