"""The whole body: one mesh with weights, colours and expressions, on the neutral skeleton or a motion's own.

Made once a process from `shapes.py` and `face.py` (half a second), always the same; coarser details are the
same surface on a wider grid. Colours are a strip of swatches that `uv` points into: orange is right, blue is
left, as on the page; the border between limb and trunk lies within triangles, where the strip changes its
colour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.body.arkit import ARKIT_SHAPES, Shape
from motionloom.pipeline.render.body.face import CONTROLS, EXPRESSIONS, Look, features, on_skin, skin_shift
from motionloom.pipeline.render.body.field import Field, skin_weights
from motionloom.pipeline.render.body.palette import HAIR, PALETTE
from motionloom.pipeline.render.body.shapes import hand, head, head_centre, nose, trunk_and_limbs
from motionloom.pipeline.render.body.surface import mesh_of

Floats = NDArray[np.float64]
Faces = Literal["expressions", "controls", "arkit"]
"""Which shapes a body's face has: those of the synthetic basis, the drawn face's controls, or ARKit's 52."""
Detail = Literal["full", "near", "far", "shadow"]
"""How fine the mesh is: for files, for figures that are watched, many or small ones, their shadows."""

_SPACING: dict[Detail, tuple[float, float, float, float]] = {
    "full": (0.019, 0.0056, 0.0095, 0.005),
    "near": (0.029, 0.0072, 0.0125, 0.006),
    "far": (0.036, 0.0125, 0.019, 0.009),
    "shadow": (0.05, 0.02, 0.032, 0.02),
}
"""The grid's spacing of trunk and limbs, hands, head and nose in metres; vertices lie on the surface."""
_SOFTNESS = (0.02, 0.004, 0.012, 0.01)
"""Over how many metres their weights fall off."""

_SWATCHES: dict[str, tuple[int, int, int]] = {
    "white": (244, 244, 240),
    "dark": (42, 38, 46),
    "hair": HAIR,
    "lip": (190, 110, 98),
    "mouth": (96, 40, 44),
}
_ROWS = 4
"""Rows of the strip: limbs and trunk; skin and hair; the swatches; nothing."""
_BORDER = 1 / 3
"""Width of each of the first row's three colours: right, trunk, left."""
_SPREAD = 0.06
"""Metres across a border over which `uv` runs from one swatch's middle to the next."""


@dataclass(frozen=True, eq=False)
class Body:
    """A skinned mesh in its skeleton's rest pose; V vertices, N joints, metres."""

    skeleton: Skeleton
    vertices: Floats
    """[V, 3], the pelvis at the origin."""
    normals: Floats
    triangles: NDArray[np.int64]
    """[F, 3], counter-clockwise from outside."""
    weights: Floats
    """How much each vertex follows each joint [V, N]; rows sum to 1, at most 4 joints each."""
    uv: Floats
    """Place in the colour strip [V, 2]."""
    expressions: dict[str, Floats]
    """Displacement [V, 3] of every vertex for each of its face's shapes at weight 1."""

    def posed(self, rotations: NDArray[Any], root: NDArray[Any], face: NDArray[Any] | None = None) -> Floats:
        """Vertices [T, V, 3] of local rotations [T, N, 3, 3], root [T, 3] and expression weights [T, E]."""
        from motionloom.datasets.motion.kinematics import forward_kinematics

        joints, world = forward_kinematics(rotations, root, self.skeleton.offsets, self.skeleton.parents)
        return self.skinned(world, joints, face)

    def skinned(self, world: NDArray[Any], joints: NDArray[Any], face: NDArray[Any] | None = None) -> Floats:
        """Vertices [T, V, 3] by linear blend skinning.

        `world` [T, N, 3, 3] turns (and may stretch) what hangs on a joint, `joints` [T, N, 3] is where it
        hangs; `face` [T, E] weighs the face's shapes.
        """
        still = np.broadcast_to(self.vertices, (len(joints), *self.vertices.shape))
        if face is not None:
            still = still + np.einsum("te,evc->tvc", face, np.stack(list(self.expressions.values())))
        shift = joints - np.einsum("tnij,nj->tni", world, self.skeleton.rest_joints)
        turned = np.einsum("vn,tnij,tvj->tvi", self.weights, world, still, optimize=True)
        return np.asarray(turned + np.einsum("vn,tni->tvi", self.weights, shift), dtype=np.float64)

    def turned_normals(self, world: NDArray[Any]) -> Floats:
        """Normals [T, V, 3] of the skinned vertices, as its joints turn them."""
        out = np.einsum("vn,tnij,vj->tvi", self.weights, world, self.normals, optimize=True)
        return np.asarray(out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-9))


def body_for(skeleton: Skeleton, faces: Faces = "expressions", detail: Detail = "full") -> Body:
    """The body on a skeleton with the joints of `smplx52` or `smpl22`, whatever its bone lengths.

    Bones are stretched along themselves, and girth goes with the whole figure's size, that of the hands with
    the hands'.
    """
    for name in ("smplx52", "smpl22"):
        known = Skeleton.named(name)
        if skeleton.joints == known.joints and skeleton.parents == known.parents:
            return _on(neutral_body(name, faces, detail), skeleton)
    raise UserError(f"skeleton {skeleton.name}: there is a body for smplx52 and smpl22 only")


@cache
def neutral_body(name: str = "smplx52", faces: Faces = "expressions", detail: Detail = "full") -> Body:
    """The body on a skeleton that ships with the package."""
    whole = _whole_body(faces, detail)
    if name == "smplx52":
        return whole
    skeleton = Skeleton.named(name)
    count = len(skeleton)
    weights = whole.weights[:, :count].copy()
    for side in ("left", "right"):
        fingers = [
            j for j, joint in enumerate(whole.skeleton.joints) if j >= count and joint.startswith(side)
        ]
        weights[:, skeleton.index(f"{side}_wrist")] += whole.weights[:, fingers].sum(axis=1)
    return replace(whole, skeleton=skeleton, weights=weights)


def colour_strip() -> NDArray[np.uint8]:
    """The picture [64, 512, 3] that `uv` points into, top row first; powers of two, for old players."""
    high, wide = 16, 512
    image = np.zeros((high * _ROWS, wide, 3), np.uint8)
    for row, colours in enumerate(
        ([PALETTE[2], PALETTE[0], PALETTE[1]], [PALETTE[3], HAIR], list(_SWATCHES.values()))
    ):
        edges = np.round(np.linspace(0, wide, len(colours) + 1)).astype(int)
        for colour, start, end in zip(colours, edges, edges[1:], strict=False):
            image[high * row : high * (row + 1), start:end] = colour
    return image


@cache
def _whole_body(faces: Faces = "expressions", detail: Detail = "full") -> Body:
    looks_of = EXPRESSIONS if faces == "expressions" else CONTROLS
    shapes = ARKIT_SHAPES if faces == "arkit" else {name: Shape(look) for name, look in looks_of.items()}
    limbs, fingers, skull, bridge = zip(_SPACING[detail], _SOFTNESS, strict=True)
    skeleton = Skeleton.named("smplx52")
    pieces = []
    field = trunk_and_limbs(skeleton)
    pieces.append(_piece(field, skeleton, limbs, lambda points: _limb_colour(points, skeleton)))
    for side, column in (("left", 5 / 6), ("right", 1 / 6)):
        pieces.append(
            _piece(hand(skeleton, side), skeleton, fingers, lambda points, u=column: _flat(points, u, 0))
        )
    centre, skin = head_centre(skeleton), head(skeleton)
    pieces.append(_piece(skin, skeleton, skull, lambda points: _skin_colour(points - centre)))
    pieces.append(_piece(nose(skeleton), skeleton, bridge, lambda points: _flat(points, 0.2, 1)))
    # Skin moves as far as it is the head's: the neck's stays.
    turn = skeleton.index("head")
    looks = {
        name: [
            skin_shift(points - centre, shape.look)
            * (shape.mask(points - centre) * weights[:, turn])[:, None]
            for points, _, _, weights, _ in pieces
        ]
        for name, shape in shapes.items()
    }
    names = list(_SWATCHES)
    parts = features()
    wanted = list(dict.fromkeys([Look(), *(shape.look for shape in shapes.values())]))
    outlines = [[part.outline(look) for part in parts] for look in wanted]
    laid = dict(zip(wanted, _laid(outlines, wanted, skin, centre), strict=True))
    for k, part in enumerate(parts):
        still = laid[Look()][k]
        column = (names.index(part.swatch) + 0.5) / len(names)
        weights = np.zeros((len(still), len(skeleton)))
        weights[:, skeleton.index("head")] = 1.0
        pieces.append((still, skin.normals(still), part.triangles, weights, _flat(still, column, 2)))
        for name, shape in shapes.items():
            looks[name].append((laid[shape.look][k] - still) * shape.mask(still - centre)[:, None])
    starts = np.cumsum([0, *(len(piece[0]) for piece in pieces)])
    return Body(
        skeleton=skeleton,
        vertices=np.concatenate([piece[0] for piece in pieces]),
        normals=np.concatenate([piece[1] for piece in pieces]),
        triangles=np.concatenate([piece[2] + start for piece, start in zip(pieces, starts, strict=False)]),
        weights=np.concatenate([piece[3] for piece in pieces]),
        uv=np.concatenate([piece[4] for piece in pieces]),
        expressions={name: np.concatenate(moves) for name, moves in looks.items()},
    )


def _piece(field: Field, skeleton: Skeleton, size: tuple[float, float], colour: Any) -> tuple[Any, ...]:
    vertices, triangles = mesh_of(field, size[0])
    weights = skin_weights(field, vertices, skeleton.parents, size[1])
    return vertices, field.normals(vertices), triangles, weights, colour(vertices)


def _laid(places: list[list[Floats]], looks: list[Look], skin: Field, centre: Floats) -> list[list[Floats]]:
    """Features' vertices [V, 3] for each look: on the resting skin (all in one go), and moved with it."""
    resting = on_skin(skin, centre, np.concatenate([part for parts in places for part in parts]))
    sizes = [len(part) for part in places[0]]
    out = []
    for look, rows in zip(looks, np.split(resting, len(looks)), strict=True):
        # What the jaw does to the lower lip is in the mouth's own outline already.
        moved = rows + skin_shift(rows - centre, replace(look, mouth_open=0.0))
        out.append(np.split(moved, np.cumsum(sizes)[:-1]))
    return out


def _flat(points: Floats, column: float, row: int) -> Floats:
    return np.tile([column, (row + 0.5) / _ROWS], (len(points), 1))


def _limb_colour(points: Floats, skeleton: Skeleton) -> Floats:
    """Trunk up to the shoulders and to a line from the crotch to the hips' outside; limbs beyond."""
    pelvis, shoulder = skeleton.rest_joints[0], skeleton.rest_joints[skeleton.index("left_shoulder")]
    x, y = np.abs(points[:, 0] - pelvis[0]), points[:, 1] - pelvis[1]
    arm = np.where(points[:, 1] > shoulder[1] - 0.15, x - (shoulder[0] + 0.01), -1.0)
    leg = 0.8 * (-0.155 + 0.75 * x - y)
    beyond = np.maximum(arm, leg)
    # 1/6 is the border between the trunk's swatch (0) and a limb's (1/3).
    away = np.clip(1 / 6 + beyond / _SPREAD / 6, 0, _BORDER)
    out = _flat(points, 0.5, 0)
    out[:, 0] += np.sign(points[:, 0] - pelvis[0]) * away
    return out


def _skin_colour(local: Floats) -> Floats:
    """Hair above a plane from the nape to the forehead, around the ears."""
    out = _flat(local, 0.5, 1)
    above = 0.66 * local[:, 1] - 0.75 * local[:, 2] + 0.006 - 0.25 * np.maximum(np.abs(local[:, 0]) - 0.07, 0)
    out[:, 0] += np.clip(above / _SPREAD / 2, -0.4, 0.4)
    return out


def _on(body: Body, skeleton: Skeleton) -> Body:
    """The mesh with each joint's surroundings stretched as its bones are."""
    stretch = stretches(body.skeleton, skeleton)
    away = body.vertices[:, None] - body.skeleton.rest_joints
    moved = np.einsum("nij,vnj->vni", stretch, away) + skeleton.rest_joints
    vertices = np.einsum("vn,vni->vi", body.weights, moved)
    local = np.einsum("vn,nij->vij", body.weights, stretch)
    normals = np.einsum("vji,vj->vi", np.linalg.inv(local), body.normals)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    looks = {name: np.einsum("vij,vj->vi", local, move) for name, move in body.expressions.items()}
    return replace(body, skeleton=skeleton, vertices=vertices, normals=normals, expressions=looks)


def stretches(known: Skeleton, skeleton: Skeleton) -> Floats:
    """What makes the surroundings of each joint of `known` fit `skeleton` [N, 3, 3]: its bones' stretch along
    them, the figure's size across.
    """
    old, new = known.offsets, skeleton.offsets
    parents = np.asarray(skeleton.parents)
    size = figure_size(known, skeleton)
    stretch = np.empty((len(skeleton), 3, 3))
    for joint in range(len(skeleton)):
        ends = np.flatnonzero(parents == joint)
        girth = _hand_size(known, skeleton, joint, size)
        if not len(ends):
            stretch[joint] = girth * np.eye(3)
            continue
        before, after = old[ends], new[ends]
        firm = 0.02 * np.square(before).sum() / len(ends)
        stretch[joint] = np.linalg.solve(
            before.T @ before + firm * np.eye(3), before.T @ after + firm * girth * np.eye(3)
        ).T
    return stretch


def figure_size(known: Skeleton, skeleton: Skeleton) -> float:
    """Sum of all bone lengths over that of `known`."""
    old, new = known.offsets, skeleton.offsets
    return float(np.linalg.norm(new, axis=-1).sum() / np.linalg.norm(old, axis=-1).sum())


def _hand_size(old: Skeleton, new: Skeleton, joint: int, size: float) -> float:
    """Girth at a joint: the figure's, for fingers their hand's."""
    name = old.joints[joint]
    side = name.split("_")[0]
    if not any(finger in name for finger in ("index", "middle", "pinky", "ring", "thumb")):
        return size
    hand = [j for j, other in enumerate(old.joints) if other.startswith(side) and other[-1] in "123"]
    before, after = (np.linalg.norm(s.offsets[hand], axis=-1).sum() for s in (old, new))
    return float(np.clip(after / before, 0.5 * size, 1.5 * size)) if after > 0 else size
