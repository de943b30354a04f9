"""The body and its poses as the page carries them: small integers in base64, unpacked by `viewer_mesh.js`.

The mesh is in the viewer's script, once a page; a motion brings its own bones and each joint's rotation. A
rotation is one 32-bit number: the three smaller components of its quaternion in 10 bits each, and which one
is left out. That is a quarter of a degree at worst and a tenth on average, 0.7 mm at the end of a thigh;
joints stay where they are, because positions travel apart.
"""

from __future__ import annotations

import base64
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.mesh import Body, Detail, figure_size, neutral_body, stretches
from motionloom.pipeline.render.body.posing import Posing

DETAILS: tuple[Detail, ...] = ("near", "far", "shadow")
COLOURS = (3, 2, 5)
"""Swatches in the rows of the colour strip (`mesh.colour_strip`)."""
_TURN_STEPS = 1022
_STILL = 1e-5


@cache
def mesh_data() -> dict[str, Any]:
    """The body in its details, as plain JSON types."""
    skeleton = Skeleton.named("smplx52")
    return {
        "parents": list(skeleton.parents),
        "rest": _floats(skeleton.rest_joints),
        "colours": list(COLOURS),
        "details": [_detail(detail) for detail in DETAILS],
    }


def pose_data(posing: Posing) -> dict[str, Any]:
    """What the page needs beside joint positions: bones, and rotations of joints that turn by themselves."""
    skeleton, parents = posing.skeleton, np.asarray(posing.skeleton.parents)
    name = "smplx52" if len(skeleton) == len(Skeleton.named("smplx52")) else "smpl22"
    known = Skeleton.named(name)
    alike = np.abs(posing.turns - posing.turns[:, parents]).max(axis=(0, 2, 3)) < _STILL
    alike[0] = False
    return {
        "turning": np.flatnonzero(~alike).tolist(),
        "turns": _text(pack_turns(posing.turns[:, ~alike]).astype("<u4")),
        "rest": _floats(skeleton.rest_joints),
        "stretch": _floats(stretches(known, skeleton)),
        "size": round(figure_size(known, skeleton), 5),
    }


def pack_turns(turns: NDArray[Any]) -> NDArray[np.uint32]:
    """Rotation matrices [..., 3, 3] as 32-bit numbers [...]."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat()
    largest = np.abs(quaternions).argmax(axis=1)
    rows = np.arange(len(quaternions))
    quaternions *= np.sign(quaternions[rows, largest])[:, None]
    others = np.stack([quaternions[rows, (largest + k) % 4] for k in (1, 2, 3)], axis=1)
    # The middle step is exactly 0, so that a figure at rest is.
    steps = np.round((others * np.sqrt(0.5) + 0.5) * _TURN_STEPS).astype(np.uint32)
    out = largest.astype(np.uint32) << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    return np.asarray(out.reshape(turns.shape[:-2]), dtype=np.uint32)


def in_reach(body: Body) -> Body:
    """The same mesh with neighbours side by side: triangles on a space-filling curve, vertices by first use.

    Renderers keep the last few vertices that they have moved; in the order of the grid, each would be moved
    for every triangle around it.
    """
    middle = body.vertices[body.triangles].mean(axis=1)
    low, high = middle.min(axis=0), middle.max(axis=0)
    cells = ((middle - low) / (high - low).max() * 1023).astype(np.int64)
    curve = np.zeros(len(cells), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            curve |= (cells[:, axis] >> bit & 1) << 3 * bit + axis
    # Parts that overlap in space stay apart.
    triangles = body.triangles[np.lexsort((curve, _piece_of(body)))]
    _, first = np.unique(triangles, return_index=True)
    order = triangles.ravel()[np.sort(first)]
    number = np.zeros(len(body.vertices), dtype=np.int64)
    number[order] = np.arange(len(order))
    return replace(
        body,
        vertices=body.vertices[order],
        normals=body.normals[order],
        triangles=number[triangles],
        weights=body.weights[order],
        uv=body.uv[order],
        expressions={name: move[order] for name, move in body.expressions.items()},
    )


def _piece_of(body: Body) -> NDArray[np.int64]:
    """Which connected piece each triangle belongs to [F]."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([body.triangles[:, [0, 1]], body.triangles[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(body.vertices),) * 2)
    label = connected_components(graph, directed=False)[1]
    return np.asarray(label[body.triangles[:, 0]], dtype=np.int64)


def _detail(detail: Detail) -> dict[str, Any]:
    body = neutral_body("smplx52", "controls", detail)
    if detail == "shadow":  # without the face
        still = {name: np.zeros_like(move) for name, move in body.expressions.items()}
        painted = body.uv[body.triangles[:, 0], 1] * 4 >= len(COLOURS) - 1
        body = replace(body, triangles=body.triangles[~painted], expressions=still)
    body = in_reach(body)
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    step = (high - low) / 65535
    places = np.round((body.vertices - low) / step)
    order = np.argsort(-body.weights, axis=1, kind="stable")[:, :4]
    shares = np.round(255 * np.take_along_axis(body.weights, order, axis=1)).astype(np.int64)
    shares[:, 0] += 255 - shares.sum(axis=1)
    row = np.minimum((body.uv[:, 1] * 4).astype(np.int64), len(COLOURS) - 1)
    colour = np.stack([np.round(255 * body.uv[:, 0]), row], axis=1)
    looks = np.stack(list(body.expressions.values()), axis=1)
    size = max(float(np.abs(looks).max()), 1e-3) / 127
    moves = np.round(looks / size)
    moving = np.flatnonzero(moves.any(axis=(1, 2)))
    return {
        "count": len(body.vertices),
        "low": low.round(6).tolist(),
        "step": step.tolist(),
        "places": _text(places.astype("<u2")),
        "joints": _text(np.where(shares > 0, order, 0).astype(np.uint8)),
        "shares": _text(shares.astype(np.uint8)),
        "colour": _text(colour.astype(np.uint8)),
        "triangles": _text(body.triangles.astype("<u2")),
        "shapes": list(body.expressions),
        "moving": _text(moving.astype("<u2")),
        "moves": _text(moves[moving].astype(np.int8)),
        "moveStep": size,
    }


def _floats(values: NDArray[Any]) -> str:
    return _text(np.asarray(values, dtype="<f4"))


def _text(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
