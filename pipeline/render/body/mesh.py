"""The body: one mesh with weights, colours and shapes of its face, read from `body.npz` beside this file.

`benchmarks/body/make_body.py` makes the file and describes its arrays. A motion has its own bone lengths: the
mesh is stretched along each bone, and girth goes with the figure's size. Orange is right, blue is left.

A rigid figure brings its rotations, so the page shows the same body as its GLB file. Bare
joints get rotations by the rule that starts a figure's fit (the smallest turn that points each bone the right
way, a hand's twist shared with its forearm), and their bones may change length from frame to frame: then the
page stretches the body along the bone, so that its joints are exactly where the motion has them **[ours]**.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.rigid import RigidMotion, share_twist
from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import ARKIT, EXPRESSIONS, ArkitBases, expression_weights

Floats = NDArray[np.float64]

FIRST_OF_HEAD = 3
"""Swatches: right, trunk, left, and from here on those of the head: skin, hair and the face."""


@dataclass(frozen=True, eq=False)
class Body:
    """A skinned mesh in its skeleton's rest pose; V vertices, N joints, metres."""

    skeleton: Skeleton
    vertices: Floats
    """[V, 3], the pelvis at the origin."""
    normals: Floats
    """[V, 3], unit length."""
    triangles: NDArray[np.int64]
    """[F, 3], counter-clockwise from outside."""
    joints: NDArray[np.int64]
    """Joints that each vertex follows [V, 4], most important first."""
    shares: Floats
    """Skinning weights of these joints [V, 4]; rows sum to 1."""
    swatch: NDArray[np.int64]
    """Row of `colours` [V]."""
    shapes: dict[str, Floats]
    """Displacement [V, 3] of every vertex for each shape of the face at weight 1."""


@cache
def asset() -> dict[str, NDArray[np.generic]]:
    """The arrays of `body.npz`."""
    file = resources.files("motionloom.pipeline.render.body") / "body.npz"
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return dict(arrays)


def colours() -> NDArray[np.uint8]:
    """Red, green and blue of each swatch [C, 3]."""
    return asset()["colours"].astype(np.uint8)


@cache
def neutral_body(name: str = "smplx52") -> Body:
    """The body on `smplx52` or `smpl22`, whose hands are stiff."""
    raw = {key.removeprefix("near_"): value for key, value in asset().items() if key.startswith("near_")}
    skeleton = Skeleton.named(name)
    whole = Skeleton.named("smplx52")
    moves = np.zeros((len(raw["shapes"]), len(raw["places"]), 3))
    moves[:, raw["moving"].astype(np.int64)] = raw["moves"].swapaxes(0, 1) * raw["move_step"].astype(float)
    normals = raw["normals"].astype(np.float64)
    own = list(range(len(skeleton)))
    for joint in range(len(skeleton), len(whole)):
        own.append(own[whole.parents[joint]])
    return Body(
        skeleton=skeleton,
        vertices=raw["low"].astype(float) + raw["step"].astype(float) * raw["places"],
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        triangles=raw["triangles"].astype(np.int64),
        joints=np.asarray(own)[raw["joints"].astype(np.int64)],
        shares=raw["shares"].astype(float) / 255,
        swatch=raw["swatch"].astype(np.int64),
        shapes=dict(zip(raw["shapes"].tolist(), moves, strict=True)),
    )


def body_for(skeleton: Skeleton, shapes: Sequence[str] = ()) -> Body:
    """The body on a skeleton with the joints of `smplx52` or `smpl22`, whatever its bone lengths.

    `shapes` are those of the face that it keeps; names that the file lacks leave the face as it is.
    """
    known = human_skeleton(skeleton.parents)
    if known is None or skeleton.joints != known.joints:
        raise UserError(f"skeleton {skeleton.name}: there is a body for smplx52 and smpl22 only")
    body = neutral_body(known.name)
    still = np.zeros_like(body.vertices)
    return _on(replace(body, shapes={s: body.shapes.get(s, still) for s in shapes}), skeleton)


def human_skeleton(parents: Sequence[int]) -> Skeleton | None:
    """The skeleton that has a body and these parents, or None."""
    key = tuple(int(parent) for parent in parents)
    known = (Skeleton.named(name) for name in ("smplx52", "smpl22"))
    return next((skeleton for skeleton in known if skeleton.parents == key), None)


def _on(body: Body, skeleton: Skeleton) -> Body:
    """The mesh with each joint's surroundings stretched as its bones are."""
    stretch = stretches(body.skeleton, skeleton)
    shift = skeleton.rest_joints - np.einsum("nij,nj->ni", stretch, body.skeleton.rest_joints)
    local = np.einsum("vk,vkij->vij", body.shares, stretch[body.joints])
    vertices = np.einsum("vij,vj->vi", local, body.vertices)
    vertices += np.einsum("vk,vki->vi", body.shares, shift[body.joints])
    normals = np.einsum("vji,vj->vi", np.linalg.inv(local), body.normals)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    shapes = {name: np.einsum("vij,vj->vi", local, move) for name, move in body.shapes.items()}
    return replace(body, skeleton=skeleton, vertices=vertices, normals=normals, shapes=shapes)


def stretches(known: Skeleton, skeleton: Skeleton) -> Floats:
    """Matrices [N, 3, 3] that fit the mesh around each joint of `known` to `skeleton`.

    Bones are stretched along themselves; across them counts the figure's size, for fingers their hand's.
    """
    old = known.offsets
    new = skeleton.offsets
    parents = np.asarray(skeleton.parents)
    size = figure_size(known, skeleton)
    stretch = np.empty((len(skeleton), 3, 3))
    for joint in range(len(skeleton)):
        ends = np.flatnonzero(parents == joint)
        girth = _girth(known, skeleton, joint, size)
        if not len(ends):
            stretch[joint] = girth * np.eye(3)
            continue
        before = old[ends]
        after = new[ends]
        # Least squares for the bones that begin here; the regulariser gives girth across them.
        firm = 0.02 * np.square(before).sum() / len(ends)
        stretch[joint] = np.linalg.solve(
            before.T @ before + firm * np.eye(3), before.T @ after + firm * girth * np.eye(3)
        ).T
    return stretch


def figure_size(known: Skeleton, skeleton: Skeleton) -> float:
    """Sum of all bone lengths over that of `known`."""
    old = known.offsets
    new = skeleton.offsets
    return float(np.linalg.norm(new, axis=-1).sum() / np.linalg.norm(old, axis=-1).sum())


def _girth(old: Skeleton, new: Skeleton, joint: int, size: float) -> float:
    """Girth at a joint: the figure's, for fingers their hand's."""
    name = old.joints[joint]
    side = name.split("_")[0]
    if not any(finger in name for finger in ("index", "middle", "pinky", "ring", "thumb")):
        return size
    hand = [j for j, other in enumerate(old.joints) if other.startswith(side) and other[-1] in "123"]
    before, after = (np.linalg.norm(s.offsets[hand], axis=-1).sum() for s in (old, new))
    return float(np.clip(after / before, 0.5 * size, 1.5 * size)) if after > 0 else size


@dataclass(frozen=True, eq=False)
class Posing:
    """T frames of a body on N joints."""

    skeleton: Skeleton
    """Names, parents and the motion's own rest offsets."""
    joints: Floats
    """[T, N, 3], metres."""
    turns: Floats
    """Rotations from the rest pose to the world [T, N, 3, 3]."""


def posing_of(joints: NDArray[np.floating], skeleton: Skeleton, figure: RigidMotion | None = None) -> Posing:
    """The body's pose at joints [T, N, 3] in metres; `figure` has their rotations, where they are known."""
    if figure is not None:
        own = figure.skeleton
        local = figure.rotations
        root = figure.root
    else:
        own = skeleton.with_lengths_of(np.asarray(joints, np.float64))
        local = share_twist(joints_to_rotations(joints, own), own)
        root = np.asarray(joints, np.float64)[:, 0]
    places, turns = forward_kinematics(local, root, own.offsets, own.parents)
    return Posing(own, places if figure is not None else np.asarray(joints, np.float64), turns)


@cache
def own_bases() -> ArkitBases:
    """The body's expressions and its ARKit shapes, both on its head."""
    shapes = body_for(Skeleton.named("smplx52"), (*EXPRESSIONS, *ARKIT)).shapes
    return ArkitBases(np.stack([shapes[n] for n in EXPRESSIONS]), np.stack([shapes[n] for n in ARKIT]))


def synthetic_arkit(expression: NDArray[np.floating]) -> Floats:
    """ARKit weights [T, 52] of synthetic expression values [T, 50], by the bases of the body's own head."""
    return own_bases().weights(expression_weights(expression))
