"""Makes the figure that pages, films and GLB files show: pipeline/render/body/body.npz.

python benchmarks/body/make_body.py pipeline/render/body/body.npz

The body is modelled here from implicit shapes (`shapes.py`, `field.py`, `surface.py`), with a face laid on
the head (`features.py`) and its shapes (`arkit_looks.py`). The package only reads the file. The result is the
same on every run. Each of the three details holds its arrays under `near_`, `far_` and `shadow_`:

* `places` uint16 [V, 3], `low` and `step` float64 [3]: vertices at rest are low + step * places, metres;
* `normals` int8 [V, 3]; `joints` and `shares` uint8 [V, 4]: which joints move a vertex, in 255ths;
* `swatch` uint8 [V]: a row of `colours`; `triangles` uint16 [F, 3], counter-clockwise from outside;
* `moving` uint16 [M], `moves` int16 [M, S, 3], `move_step`: how far each of `shapes` moves these vertices.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from arkit_looks import ARKIT_SHAPES, Shape
from features import CONTROLS, EXPRESSIONS, Look, features, on_skin, skin_shift
from field import Field, Floats, skin_weights
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from shapes import hand, head, head_centre, nose, trunk_and_limbs
from surface import mesh_of

from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.motion.skeleton import Skeleton

SPACING = {
    "near": (0.029, 0.0072, 0.0125, 0.006),
    "far": (0.036, 0.0125, 0.019, 0.009),
    "shadow": (0.05, 0.02, 0.032, 0.02),
}
"""The grid's spacing of trunk and limbs, hands, head and nose in metres; vertices lie on the surface."""
SOFTNESS = (0.02, 0.004, 0.012, 0.01)
"""Over how many metres their weights fall off."""
COLOURS = {
    "right": (229, 121, 63),
    "centre": (119, 130, 154),
    "left": (47, 143, 196),
    "skin": (237, 199, 163),
    "hair": (90, 68, 54),
    "white": (244, 244, 240),
    "dark": (42, 38, 46),
    "brow": (90, 68, 54),
    "lip": (190, 110, 98),
    "mouth": (96, 40, 44),
}
"""What a vertex is painted with; the page's style names them in this order."""
CONTROL_SHAPES = {name: Shape(look) for name, look in CONTROLS.items()}
SHAPES = {
    "near": CONTROL_SHAPES
    | {name: Shape(look) for name, look in EXPRESSIONS.items()}
    | {name: shape for name, shape in ARKIT_SHAPES.items() if shape.look != Look()},
    "far": CONTROL_SHAPES,
    "shadow": {},
}
"""The face's shapes of each detail: the page and the film only use the controls."""
Paint = Callable[[Floats], list[tuple[Floats, str, str]]]


@dataclass(frozen=True, eq=False)
class Piece:
    """A closed surface or a patch of the face: V vertices, F triangles, S shapes of the face."""

    vertices: Floats
    normals: Floats
    triangles: NDArray[np.int64]
    weights: Floats
    """[V, N]."""
    moves: Floats
    """[V, S, 3]."""
    paint: NDArray[np.int64]
    """Swatch of each triangle [F]."""


def make_detail(detail: str) -> Piece:
    """The whole body at one detail; the shadow's has no features on its face."""
    skeleton = Skeleton.named("smplx52")
    limbs, fingers, skull, bridge = zip(SPACING[detail], SOFTNESS, strict=True)
    shapes = list(SHAPES[detail].values())
    centre, skin = head_centre(skeleton), head(skeleton)
    turn = skeleton.index("head")

    def piece(field: Field, size: tuple[float, float], borders: Paint) -> Piece:
        vertices, triangles = mesh_of(field, size[0])
        weights = skin_weights(field, vertices, skeleton.parents, size[1])
        local = vertices - centre
        # Skin moves as far as it is the head's: the neck's stays.
        moves = [skin_shift(local, s.look) * (s.mask(local) * weights[:, turn])[:, None] for s in shapes]
        return painted(
            Piece(vertices, field.normals(vertices), triangles, weights, _stacked(moves, len(vertices)),
                  np.zeros(len(triangles), np.int64)),
            borders,
        )  # fmt: skip

    pieces = [piece(trunk_and_limbs(skeleton), limbs, lambda points: _limb_borders(points, skeleton))]
    pieces += [
        piece(
            hand(skeleton, side), fingers, lambda points, side=side: [(np.ones(len(points)), "centre", side)]
        )
        for side in ("left", "right")
    ]
    pieces.append(piece(skin, skull, lambda points: [(_hair_border(points - centre), "skin", "hair")]))
    pieces.append(piece(nose(skeleton), bridge, lambda points: [(np.ones(len(points)), "hair", "skin")]))
    if detail != "shadow":
        pieces += _features(skin, centre, shapes, len(skeleton), turn)
    starts = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    return Piece(
        *(np.concatenate([getattr(p, name) for p in pieces]) for name in ("vertices", "normals")),
        triangles=np.concatenate([p.triangles + s for p, s in zip(pieces, starts, strict=False)]),
        **{
            name: np.concatenate([getattr(p, name) for p in pieces]) for name in ("weights", "moves", "paint")
        },
    )


def painted(piece: Piece, borders: Paint) -> Piece:
    """The piece with its triangles cut along each border, and painted on either side of it.

    A border is (value [V], swatch where it is below 0, swatch above); where the first leaves "" as it is, the
    paint of the borders before shows.
    """
    names = list(COLOURS)
    for number in range(len(borders(piece.vertices))):
        value, below, above = borders(piece.vertices)[number]
        piece, side = _cut(piece, value)
        paint = piece.paint.copy()
        for chosen, name in ((~side, below), (side, above)):
            if name:
                paint[chosen] = names.index(name)
        piece = replace(piece, paint=paint)
    return piece


def _cut(piece: Piece, value: Floats) -> tuple[Piece, NDArray[np.bool_]]:
    """Triangles that `value` [V] changes its sign in are split there; also which are above 0 now [F]."""
    triangles, paint = piece.triangles, piece.paint
    above = value[triangles] >= 0
    whole = above.all(axis=1) | ~above.any(axis=1)
    out, sides, colours = [triangles[whole]], [above[whole, 0]], [paint[whole]]
    edges: dict[tuple[int, int], int] = {}
    ends: list[tuple[int, int]] = []

    def middle(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in edges:
            edges[key] = len(value) + len(ends)
            ends.append(key)
        return edges[key]

    for corners, signs, colour in zip(triangles[~whole], above[~whole], paint[~whole], strict=True):
        alone = int(np.flatnonzero(signs == (signs.sum() == 1))[0])
        a, b, c = (int(corners[(alone + k) % 3]) for k in range(3))
        ab, ac = middle(a, b), middle(a, c)
        out.append(np.array([[a, ab, ac], [ab, b, c], [ab, c, ac]]))
        sides.append(np.array([signs[alone], ~signs[alone], ~signs[alone]]))
        colours.append(np.full(3, colour))
    pairs = np.array(ends, dtype=np.int64).reshape(-1, 2)
    one, two = pairs.T
    share = value[one] / (value[one] - value[two])

    def grown(values: Floats) -> Floats:
        part = share.reshape(-1, *[1] * (values.ndim - 1))
        return np.concatenate([values, (1 - part) * values[one] + part * values[two]])

    normals = grown(piece.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cut = Piece(grown(piece.vertices), normals, np.concatenate(out), grown(piece.weights), grown(piece.moves),
                np.concatenate(colours))  # fmt: skip
    return cut, np.concatenate(sides)


def _features(skin: Field, centre: Floats, shapes: list[Shape], joints: int, turn: int) -> list[Piece]:
    """Eyes, brows and mouth, laid on the head and moved with it."""
    looks = list(dict.fromkeys([Look(), *(shape.look for shape in shapes)]))
    out = []
    for part in features():
        laid = {look: _laid(part.outline(look), look, skin, centre) for look in looks}
        still = laid[Look()]
        moves = [(laid[s.look] - still) * s.mask(still - centre)[:, None] for s in shapes]
        weights = np.zeros((len(still), joints))
        weights[:, turn] = 1.0
        paint = np.full(
            len(part.triangles), list(COLOURS).index({"hair": "brow"}.get(part.swatch, part.swatch))
        )
        out.append(
            Piece(still, skin.normals(still), part.triangles, weights, _stacked(moves, len(still)), paint)
        )
    return out


def _laid(places: Floats, look: Look, skin: Field, centre: Floats) -> Floats:
    """A feature's vertices [V, 3]: on the resting skin, and moved with it."""
    rows = on_skin(skin, centre, places)
    # What the jaw does to the lower lip is in the mouth's own outline already.
    return rows + skin_shift(rows - centre, replace(look, mouth_open=0.0))


def _stacked(moves: list[Floats], count: int) -> Floats:
    return np.stack(moves, axis=1) if moves else np.zeros((count, 0, 3))


def _limb_borders(points: Floats, skeleton: Skeleton) -> list[tuple[Floats, str, str]]:
    """Trunk up to the shoulders and to a line from the crotch to the hips' outside; limbs beyond."""
    pelvis, shoulder = skeleton.rest_joints[0], skeleton.rest_joints[skeleton.index("left_shoulder")]
    out = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        x, y = sign * (points[:, 0] - pelvis[0]), points[:, 1] - pelvis[1]
        arm = np.where(points[:, 1] > shoulder[1] - 0.15, x - (shoulder[0] + 0.01), -1.0)
        leg = np.where(x > -0.02, 0.8 * (-0.155 + 0.75 * np.maximum(x, 0) - y), -1.0)
        beyond = np.maximum(arm, np.minimum(leg, x + 1e-4))
        out.append((beyond, "centre" if side == "left" else "", side))
    return out


def _hair_border(local: Floats) -> Floats:
    """Above 0 over a plane from the nape to the forehead, around the ears."""
    return 0.66 * local[:, 1] - 0.75 * local[:, 2] + 0.006 - 0.25 * np.maximum(np.abs(local[:, 0]) - 0.07, 0)


def flattened(piece: Piece) -> tuple[Piece, NDArray[np.int64]]:
    """The piece with one swatch a vertex [V]: vertices between two colours are there twice.

    Neighbours lie side by side, triangles on a space-filling curve and vertices by first use: renderers keep
    the last few vertices that they have moved.
    """
    triangles = piece.triangles
    size = np.linalg.norm(
        np.cross(*(piece.vertices[triangles[:, k]] - piece.vertices[triangles[:, 0]] for k in (1, 2))), axis=1
    )
    triangles, paint = triangles[size > 1e-12], piece.paint[size > 1e-12]
    middle = piece.vertices[triangles].mean(axis=1)
    low, high = middle.min(axis=0), middle.max(axis=0)
    cells = ((middle - low) / (high - low).max() * 1023).astype(np.int64)
    curve = np.zeros(len(cells), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            curve |= (cells[:, axis] >> bit & 1) << 3 * bit + axis
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(piece.vertices),) * 2)
    label = connected_components(graph, directed=False)[1]
    # Parts that overlap in space stay apart.
    order = np.lexsort((curve, label[triangles[:, 0]]))
    key = (triangles[order] * len(COLOURS) + paint[order][:, None]).ravel()
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    kept = key[np.sort(first)]
    rows = kept // len(COLOURS)
    return (
        Piece(
            piece.vertices[rows], piece.normals[rows], rank[inverse].reshape(-1, 3), piece.weights[rows],
            piece.moves[rows], paint[order],
        ),
        kept % len(COLOURS),
    )  # fmt: skip


def packed(detail: str) -> dict[str, NDArray[np.generic]]:
    """The arrays of one detail."""
    piece, swatch = flattened(make_detail(detail))
    low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
    step = (high - low) / 65535
    order = np.argsort(-piece.weights, axis=1, kind="stable")[:, :4]
    shares = np.take_along_axis(piece.weights, order, axis=1)
    shares = np.round(255 * shares / shares.sum(axis=1, keepdims=True)).astype(np.int64)
    shares[:, 0] += 255 - shares.sum(axis=1)
    move_step = max(float(np.abs(piece.moves).max(initial=0.0)), 1e-3) / 32767
    moves = np.round(piece.moves / move_step)
    moving = np.flatnonzero((np.abs(piece.moves) > 2e-5).any(axis=(1, 2)))
    arrays = {
        "low": low,
        "step": step,
        "places": np.round((piece.vertices - low) / step).astype(np.uint16),
        "normals": np.round(127 * piece.normals).astype(np.int8),
        "joints": np.where(shares > 0, order, 0).astype(np.uint8),
        "shares": shares.astype(np.uint8),
        "swatch": swatch.astype(np.uint8),
        "triangles": piece.triangles.astype(np.uint16),
        "moving": moving.astype(np.uint16),
        "moves": moves[moving].astype(np.int16),
        "move_step": np.float64(move_step),
        "shapes": np.array(list(SHAPES[detail]), dtype=np.str_),
    }
    return {f"{detail}_{name}": np.asarray(values) for name, values in arrays.items()}


def main() -> None:
    """Write the file that is named."""
    path = Path(sys.argv[1])
    arrays: dict[str, NDArray[np.generic]] = {"colours": np.array(list(COLOURS.values()), np.uint8)}
    for detail in SPACING:
        arrays |= packed(detail)
        print(
            detail,
            len(arrays[f"{detail}_places"]),
            "vertices",
            len(arrays[f"{detail}_triangles"]),
            "triangles",
        )
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
