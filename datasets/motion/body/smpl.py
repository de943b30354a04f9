"""SMPL, SMPL-H and SMPL-X parameters -> joints, without the mesh.

A body model poses its joints by forward kinematics on the rest joints of the body shape; the mesh only
follows them. The rest joints are linear in the shape: J (v + S b) = J v + (J S) b, so a model file is reduced
once to [N, 3] + [N, 3, B] and no vertex is touched again.

Without a model file (they are licensed, and never part of this project) the neutral skeleton of
`skeletons/*.json` stands in: the pose is the clip's, the bone lengths are those of one neutral adult, and
`betas` has no effect. `BodyModel.statement` says which of the two made the joints.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.motion.skeleton import Skeleton

SkeletonName = Literal["smpl22", "smplx52"]

FINGERS = 30
"""Joints of both hands."""

_MODELS = {24: ("SMPL", None), 52: ("SMPL-H", 22), 55: ("SMPL-X", 25)}
"""Joints of a model -> its name and its first finger joint (SMPL-X has jaw and eyes before the fingers)."""

_MAX_VERTICES = 100_000
_MODEL_BYTES = 2**29
"""Largest array of a body model that is read; SMPL-X has 10,475 vertices and shape directions of 100 MB."""

_PICKLE = (
    "is a pickle, which can run code and is never opened here; where chumpy and scipy are installed, save "
    "the model once with numpy.savez(J_regressor=..., v_template=..., shapedirs=..., kintree_table=...) as "
    "plain arrays (docs/sources.md has the lines)"
)


@dataclass(frozen=True, eq=False)
class BodyModel:
    """Rest joints of a body as a function of its shape: a few kilobytes, whatever the mesh behind it."""

    skeleton: Skeleton
    template: NDArray[np.float64]
    """Rest joints [N, 3] of the mean shape, metres, in the model's own coordinates."""
    directions: NDArray[np.float64]
    """Change of the rest joints [N, 3, B] with each shape value."""
    statement: dict[str, Any]
    """The origin of the joints, as plain JSON for the manifest."""

    @staticmethod
    @cache
    def neutral(skeleton: SkeletonName) -> BodyModel:
        """Return the neutral skeleton that ships with the package; every shape has its bones."""
        named = Skeleton.named(skeleton)
        statement = {
            "kind": "neutral skeleton",
            "skeleton": skeleton,
            "sentence": "No body model: poses are the source's, bone lengths those of one neutral adult, "
            "shape values (betas) have no effect.",
        }
        return BodyModel(named, named.rest_joints, np.zeros((len(named), 3, 0)), statement)

    @staticmethod
    def load(path: Path, skeleton: SkeletonName) -> BodyModel:
        """The user's SMPL, SMPL-H or SMPL-X model (.npz), reduced to the joints of `skeleton`.

        Reads `J_regressor` [J, V], `v_template` [V, 3], `shapedirs` [V, 3, B] and `kintree_table` [2, J].
        Refuses pickles, and trees that are not SMPL's.
        """
        if path.suffix.lower() in (".pkl", ".pickle"):
            raise UserError(f"{path} {_PICKLE}")
        named = Skeleton.named(skeleton)
        # Sizes are compared before each array is read: a model of another kind, or a bomb, costs nothing.
        with NpzFile(path) as file:
            tree = file.numbers("kintree_table", limit=2**20)
            kind, chosen = _choose(path, tree, named)
            vertices = file.numbers("v_template", limit=_MODEL_BYTES)
            if vertices.ndim != 2 or vertices.shape[1] != 3 or not 0 < len(vertices) <= _MAX_VERTICES:
                raise UserError(f"{path}: v_template is {list(vertices.shape)}, not [V, 3]")
            shapes = _shapes(file, len(vertices), kind)
            regressor = _regressor(file, tree.shape[1], len(vertices))[chosen]
        for name, values in (("J_regressor", regressor), ("v_template", vertices), ("shapedirs", shapes)):
            if not np.isfinite(values).all():
                raise UserError(f"{path}: NaN or infinity in {name}")
        with path.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        statement = {
            "kind": kind,
            "skeleton": skeleton,
            "file": path.name,
            "sha256": sha256,
            "shape_values": shapes.shape[2],
            "sentence": f"Joints of the user's {kind} model, posed by forward kinematics from the rest "
            f"joints of each clip's shape (betas).",
        }
        # Joints are linear in vertices and these in shape, so both are folded: no mesh is kept.
        directions = np.tensordot(regressor, shapes, axes=1)
        return BodyModel(named, regressor @ vertices, directions, statement)

    def rest_joints(self, betas: NDArray[np.floating] | None = None) -> NDArray[np.float64]:
        """Rest joints [N, 3] in metres of a shape [B'], in the model's coordinates (the pelvis is not at 0).

        Values beyond the model's B are ignored and missing ones are 0: shape values are sorted by importance,
        and sources store 10 or 16 of them for models of 10 to 300.
        """
        if betas is None or not self.directions.shape[2]:
            return self.template
        if betas.ndim != 1:
            raise UserError(f"betas are {list(betas.shape)}, not one shape [B]")
        used = min(len(betas), self.directions.shape[2])
        return self.template + self.directions[:, :, :used] @ betas[:used].astype(np.float64)


def smpl_joints(
    rotvecs: NDArray[np.floating],
    trans: NDArray[np.floating],
    body: BodyModel,
    betas: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Joints [..., T, N, 3] in metres of SMPL parameters, in the source's world axes.

    `rotvecs` [..., T, N, 3] are local axis-angles in radians, joint 0 the root orientation; `trans`
    [..., T, 3] in metres is what the model adds to every vertex, so the root stands at rest pelvis + trans.
    `betas` [B] is one shape for all frames. The joints are those of the model itself, to rounding.
    """
    from scipy.spatial.transform import Rotation

    count = len(body.skeleton)
    if rotvecs.shape[-2:] != (count, 3) or trans.shape != (*rotvecs.shape[:-2], 3):
        raise UserError(
            f"skeleton {body.skeleton.name} needs rotations [T, {count}, 3] and translations [T, 3], not "
            f"{list(rotvecs.shape)} and {list(trans.shape)}"
        )
    rest = body.rest_joints(betas)
    offsets = body.skeleton.bones(rest)
    # scipy's conversion takes a quarter of roma's time for one clip, which small torch calls make up.
    local = Rotation.from_rotvec(rotvecs.reshape(-1, 3)).as_matrix().reshape(*rotvecs.shape, 3)
    return forward_kinematics(local, rest[0] + trans, offsets, body.skeleton.parents)[0]


def _choose(path: Path, tree: NDArray[np.float64], skeleton: Skeleton) -> tuple[str, list[int]]:
    """Name of the model and its joints in the skeleton's order; `UserError` unless the trees agree."""
    if tree.ndim != 2 or len(tree) != 2 or tree.shape[1] not in _MODELS:
        raise UserError(
            f"{path}: kintree_table is {list(tree.shape)}; SMPL has [2, 24], SMPL-H [2, 52], SMPL-X [2, 55]"
        )
    kind, fingers = _MODELS[tree.shape[1]]
    chosen = list(range(BODY_JOINTS))
    if len(skeleton) > BODY_JOINTS:
        if fingers is None:
            raise UserError(f"{path}: {kind} has no fingers, but skeleton {skeleton.name} does; use SMPL-H/X")
        chosen += range(fingers, fingers + FINGERS)
    parents = tree[0, chosen].tolist()  # as numbers: they may be NaN
    wanted = [chosen[parent] for parent in skeleton.parents[1:]]
    if parents[1:] != wanted or (tree[1] != np.arange(tree.shape[1])).any():
        raise UserError(f"{path}: kintree_table is not the joint tree of {kind}")
    return kind, chosen


def _shapes(file: NpzFile, vertices: int, kind: str) -> NDArray[np.float64]:
    """Shape directions [V, 3, B], without SMPL-X's expression."""
    shapes = file.numbers("shapedirs", limit=_MODEL_BYTES)
    if shapes.ndim != 3 or shapes.shape[:2] != (vertices, 3):
        raise UserError(f"{file.label}: shapedirs is {list(shapes.shape)}, not [{vertices}, 3, B]")
    if kind == "SMPL-X":
        # Shape comes first, expression behind it: 300 + 100 in the current files, 10 + 10 in the first ones.
        shapes = shapes[:, :, : 300 if shapes.shape[2] >= 300 else 10]
    return shapes


def _regressor(file: NpzFile, joints: int, vertices: int) -> NDArray[np.float64]:
    """Joint regressor [J, V]."""
    regressor = file.numbers("J_regressor", limit=_MODEL_BYTES)
    if regressor.shape != (joints, vertices):
        raise UserError(f"{file.label}: J_regressor is {list(regressor.shape)}, not {[joints, vertices]}")
    return regressor
