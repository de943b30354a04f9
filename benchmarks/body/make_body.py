"""Makes the figure that pages and GLB files show: pipeline/render/body/body.npz.

python benchmarks/body/make_body.py pipeline/render/body/body.npz

The body is modelled here from implicit shapes (`shapes.py`, `field.py`), with a face laid on
the head and its shapes (`features.py`). The package only reads the file. The result is the
same on every run. Each of the three details holds its arrays under `near_`, `far_` and `shadow_`:

* `places` uint16 [V, 3], `low` and `step` float64 [3]: vertices at rest are low + step * places, metres;
* `normals` int8 [V, 3]; `joints` and `shares` uint8 [V, 4]: which joints move a vertex, in 255ths;
* `swatch` uint8 [V]: a row of `colours`; `triangles` uint16 [F, 3], counter-clockwise from outside;
* `moving` uint16 [M], `moves` int16 [M, S, 3], `move_step`: how far each of `shapes` moves these vertices.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from features import (
    ARKIT_SHAPES,
    CONTROLS,
    EXPRESSIONS,
    Feature,
    Look,
    Shape,
    behind_mouth,
    features,
    on_skin,
    skin_shift,
)  # fmt: skip
from field import Field, Floats, mesh_of, normals_of, skin_weights
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from shapes import collar, cuff, ears, hair, hand, head, head_centre, nose, spread, trunk_and_limbs

from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.motion.skeleton import Skeleton

SPACING = {
    "near": (0.03, 0.0079, 0.0132, 0.0068),
    "far": (0.0395, 0.0138, 0.021, 0.0115),
    "shadow": (0.05, 0.02, 0.032, 0.02),
}
"""The grid's spacing of trunk and limbs, hands, head, nose and ears; metres, vertices lie on the surface."""
LIMBS, FINGERS, WRIST, HEAD = 0.02, 0.004, 0.018, 0.012
"""Over how many metres their weights fall off."""
HIDDEN = 0.004
"""Surfaces are left out where another one that moves alike is so many metres above them."""
UNSEEN = 3e-4
"""Vertices that no shape moves farther, in metres, stay where they are."""
DENT = 0.03
"""Metres that the skin is pressed in behind the mouth."""
COLOURS = {
    "right": (229, 121, 63),
    "centre": (119, 130, 154),
    "left": (47, 143, 196),
    "skin": (237, 199, 163),
    "hair": (90, 68, 54),
    "white": (244, 244, 240),
    "dark": (42, 38, 46),
    "brow": (90, 68, 54),
    "lip": (194, 124, 108),
    "mouth": (82, 34, 38),
}
"""The paint of a vertex; the page's style names them in this order."""
CONTROL_SHAPES = {name: Shape(look) for name, look in CONTROLS.items()}
SHAPES = {
    "near": CONTROL_SHAPES
    | {name: Shape(look) for name, look in EXPRESSIONS.items()}
    | {name: shape for name, shape in ARKIT_SHAPES.items() if shape.look != Look()},
    "far": CONTROL_SHAPES,
    "shadow": {},
}
"""The face's shapes of each detail: the page only uses the controls."""
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
    limbs, fingers, skull, fine = SPACING[detail]
    shapes = list(SHAPES[detail].values())
    centre = head_centre(skeleton)
    turn = skeleton.index("head")
    trunk = trunk_and_limbs(skeleton)
    skin = head(skeleton)
    hairs = hair(skeleton)

    def piece(field: Field, spacing: float, softness: float, swatch: str, *over: Field) -> Piece:
        vertices, triangles = mesh_of(field, spacing)
        weights = skin_weights(field, vertices, skeleton.parents, softness)
        local = vertices - centre
        # Skin moves as far as it is the head's: the neck's stays.
        moves = np.zeros((len(vertices), len(shapes), 3))
        if swatch == "skin":
            for k, shape in enumerate(shapes):
                moves[:, k] = skin_shift(local, shape.look) * (shape.mask(local) * weights[:, turn])[:, None]
        if field is skin:
            vertices[behind_mouth(local, triangles), 2] -= DENT
        triangles = _seen(vertices, triangles, over)
        paint = np.full(len(triangles), list(COLOURS).index(swatch))
        return Piece(vertices, field.normals(vertices), triangles, weights, moves, paint)

    pieces = [
        painted(piece(trunk, limbs, LIMBS, "centre"), lambda points: _limb_borders(points, skeleton)),
        piece(skin, skull, HEAD, "skin", hairs, trunk),
        piece(hairs, skull, HEAD, "hair", skin),
    ]
    pieces += [_hand(skeleton, side, fingers, len(shapes), trunk) for side in ("left", "right")]
    if detail != "shadow":
        pieces += [piece(field(skeleton), fine, HEAD, "skin", skin, hairs) for field in (nose, ears)]
        bands = [(collar(skeleton), "spine3", "centre")]
        bands += [(cuff(skeleton, side), f"{side}_elbow", side) for side in ("left", "right")]
        pieces += [_band(*band, len(shapes)) for band in bands]
        pieces += [_feature(part, skin, centre, shapes, skeleton) for part in features()]
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
    triangles = piece.triangles
    paint = piece.paint
    above = value[triangles] >= 0
    whole = above.all(axis=1) | ~above.any(axis=1)
    out = [triangles[whole]]
    sides = [above[whole, 0]]
    colours = [paint[whole]]
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
        ab = middle(a, b)
        ac = middle(a, c)
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


def _seen(vertices: Floats, triangles: NDArray[np.int64], over: Sequence[Field]) -> NDArray[np.int64]:
    """The triangles that are not deep inside one of the fields."""
    for field in over:
        triangles = triangles[(field.value(vertices) > -HIDDEN)[triangles].any(axis=1)]
    return triangles


def _hand(skeleton: Skeleton, side: str, spacing: float, shapes: int, sleeve: Field) -> Piece:
    """A hand, made with its fingers apart and brought back into the rest pose by its own weights."""
    apart, turns = spread(skeleton)
    field = hand(apart, side)
    vertices, triangles = mesh_of(field, spacing)
    wrist, knuckle = (apart.rest_joints[apart.index(f"{side}_{joint}")] for joint in ("wrist", "middle1"))
    along = np.clip((vertices - wrist) @ (knuckle - wrist) / np.square(knuckle - wrist).sum(), 0, 1)
    weights = skin_weights(field, vertices, skeleton.parents, WRIST + along * (FINGERS - WRIST))
    turned = np.einsum("vj,jab->vab", weights, turns)
    shift = weights @ (apart.rest_joints - np.einsum("jab,jb->ja", turns, skeleton.rest_joints))
    rest = np.linalg.solve(turned, (vertices - shift)[..., None])[..., 0]
    normals = np.einsum("vba,vb->va", turned, field.normals(vertices))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = _seen(vertices, triangles, [sleeve])
    paint = np.full(len(triangles), list(COLOURS).index(side))
    return Piece(rest, normals, triangles, weights, np.zeros((len(rest), shapes, 3)), paint)


def _band(rows: Floats, joint: str, swatch: str, shapes: int) -> Piece:
    """A band of rows [R, around, 3], left to right as seen from outside, that moves with one joint."""
    skeleton = Skeleton.named("smplx52")
    (count, around) = rows.shape[:2]
    one = np.arange((count - 1) * around)
    two = one - one % around + (one + 1) % around
    triangles = np.concatenate(
        [np.stack([one, one + around, two], 1), np.stack([two, one + around, two + around], 1)]
    )
    vertices = rows.reshape(-1, 3)
    weights = np.zeros((len(vertices), len(skeleton)))
    weights[:, skeleton.index(joint)] = 1.0
    normals = normals_of(vertices, triangles, vertices)
    paint = np.full(len(triangles), list(COLOURS).index(swatch))
    return Piece(vertices, normals, triangles, weights, np.zeros((len(vertices), shapes, 3)), paint)


def _feature(part: Feature, skin: Field, centre: Floats, shapes: list[Shape], skeleton: Skeleton) -> Piece:
    """A patch laid on the head, and moved with it."""
    laid: dict[Look, Floats] = {}
    for look in (Look(), *(shape.look for shape in shapes)):
        rows = on_skin(skin, centre, part.outline(look))
        laid[look] = rows + skin_shift(rows - centre, look, part.jaw)
    still = laid[Look()]
    moves = [(laid[s.look] - still) * s.mask(still - centre)[:, None] for s in shapes]
    weights = np.zeros((len(still), len(skeleton)))
    weights[:, skeleton.index("head")] = 1.0
    normals = skin.normals(still)
    if part.round:
        normals = normals_of(still, part.triangles, normals)
    paint = np.full(len(part.triangles), list(COLOURS).index(part.swatch))
    return Piece(still, normals, part.triangles, weights, _stacked(moves, len(still)), paint)


def _stacked(moves: list[Floats], count: int) -> Floats:
    return np.stack(moves, axis=1) if moves else np.zeros((count, 0, 3))


def _limb_borders(points: Floats, skeleton: Skeleton) -> list[tuple[Floats, str, str]]:
    """Trunk up to the shoulders and to a line from the crotch to the hips' outside; limbs beyond."""
    pelvis = skeleton.rest_joints[0]
    shoulder = skeleton.rest_joints[skeleton.index("left_shoulder")]
    out = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        x = sign * (points[:, 0] - pelvis[0])
        y = points[:, 1] - pelvis[1]
        arm = np.where(points[:, 1] > shoulder[1] - 0.15, x - (shoulder[0] + 0.01), -1.0)
        leg = np.where(x > -0.02, 0.8 * (-0.155 + 0.75 * np.maximum(x, 0) - y), -1.0)
        beyond = np.maximum(arm, np.minimum(leg, x + 1e-4))
        out.append((beyond, "centre" if side == "left" else "", side))
    return out


def flattened(piece: Piece) -> tuple[Piece, NDArray[np.int64]]:
    """The piece with one swatch a vertex [V]: vertices between two colours are there twice.

    Neighbours lie side by side, triangles on a space-filling curve and vertices by first use: renderers keep
    the last few vertices that they have moved.
    """
    triangles = piece.triangles
    size = np.linalg.norm(
        np.cross(*(piece.vertices[triangles[:, k]] - piece.vertices[triangles[:, 0]] for k in (1, 2))), axis=1
    )
    triangles = triangles[size > 1e-12]
    paint = piece.paint[size > 1e-12]
    middle = piece.vertices[triangles].mean(axis=1)
    low = middle.min(axis=0)
    high = middle.max(axis=0)
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
    low = piece.vertices.min(axis=0)
    high = piece.vertices.max(axis=0)
    step = (high - low) / 65535
    order = np.argsort(-piece.weights, axis=1, kind="stable")[:, :4]
    shares = np.take_along_axis(piece.weights, order, axis=1)
    shares = np.round(255 * shares / shares.sum(axis=1, keepdims=True)).astype(np.int64)
    shares[:, 0] += 255 - shares.sum(axis=1)
    move_step = max(float(np.abs(piece.moves).max(initial=0.0)), 1e-3) / 32767
    moves = np.round(piece.moves / move_step)
    moving = np.flatnonzero((np.abs(piece.moves) > UNSEEN).any(axis=(1, 2)))
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
        counts = [len(arrays[f"{detail}_{name}"]) for name in ("places", "triangles")]
        print("{}: {} vertices, {} triangles".format(detail, *counts))
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
