"""The body and its poses as the page carries them: small integers in base64.

The mesh is in the viewer's script, once a page; a motion brings its own bones and each joint's rotation. A
rotation is one 32-bit number: the three smaller components of its quaternion in 10 bits each, and which one
is left out. That is a quarter of a degree at worst and a tenth on average, 0.7 mm at the end of a thigh;
joints keep their places, because positions travel apart.
"""

from __future__ import annotations

import base64
from functools import cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import CONTROLS
from motionloom.pipeline.render.body.mesh import Posing, asset, figure_size, human_skeleton, stretches

_TURN_STEPS = 1022
_STILL = 1e-5


@cache
def mesh_data() -> dict[str, object]:
    """The body in its details, as plain JSON types."""
    skeleton = Skeleton.named("smplx52")
    return {
        "parents": list(skeleton.parents),
        "rest": packed(skeleton.rest_joints, "<f4"),
        "details": [_detail(detail) for detail in ("near", "far", "shadow")],
    }


def _detail(name: str) -> dict[str, object]:
    arrays = asset()
    low, step, shapes = (arrays[f"{name}_{key}"].tolist() for key in ("low", "step", "shapes"))
    chosen = [shapes.index(shape) for shape in CONTROLS] if shapes else []
    moves = arrays[f"{name}_moves"][:, chosen] * arrays[f"{name}_move_step"].astype(float)
    size = max(float(np.abs(moves).max(initial=0.0)), 1e-3) / 127
    moves = np.round(moves / size)
    # Most vertices never move; only the others have a row.
    moving = np.flatnonzero(moves.any(axis=(1, 2)))
    out: dict[str, object] = {
        key: packed(arrays[f"{name}_{key}"])
        for key in ("places", "normals", "joints", "shares", "swatch", "triangles")
    }
    return out | {
        "low": low,
        "step": step,
        "shapes": len(CONTROLS),
        "moving": packed(arrays[f"{name}_moving"][moving]),
        "moves": packed(moves[moving], "i1"),
        "moveStep": size,
    }


def pose_data(posing: Posing) -> dict[str, object]:
    """The bones, and rotations of the joints that turn by themselves (`turning`); arrays are base64."""
    skeleton, parents = posing.skeleton, np.asarray(posing.skeleton.parents)
    known = human_skeleton(skeleton.parents)
    assert known is not None  # only bodies are posed
    alike = np.abs(posing.turns - posing.turns[:, parents]).max(axis=(0, 2, 3)) < _STILL
    alike[0] = False
    return {
        "turning": np.flatnonzero(~alike).tolist(),
        "turns": packed(pack_turns(posing.turns[:, ~alike]), "<u4"),
        "rest": packed(skeleton.rest_joints, "<f4"),
        "stretch": packed(stretches(known, skeleton), "<f4"),
        "size": round(figure_size(known, skeleton), 5),
    }


def pack_turns(turns: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Rotation matrices [..., 3, 3] as 32-bit numbers [...]."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat()
    largest = np.abs(quaternions).argmax(axis=1)
    rows = np.arange(len(quaternions))
    # q and -q are one rotation: with the largest component positive, the reader can compute it.
    quaternions *= np.sign(quaternions[rows, largest])[:, None]
    others = np.stack([quaternions[rows, (largest + k) % 4] for k in (1, 2, 3)], axis=1)
    # The middle step is exactly 0, so that a figure at rest is.
    steps = np.round((others * np.sqrt(0.5) + 0.5) * _TURN_STEPS).astype(np.uint32)
    out = largest.astype(np.uint32) << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    return np.asarray(out.reshape(turns.shape[:-2]), dtype=np.uint32)


def packed(values: NDArray[np.generic], kind: DTypeLike | None = None) -> str:
    """The bytes of an array, little-endian, as base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")
