"""Forward kinematics, and rotations from joint positions (for BVH export of generated joints).

Rotations are local matrices [..., N, 3, 3] (child frame to parent frame; column vectors), offsets are rest
offsets in metres, parents come before their children. Inside, matrices are axes-first, [3, 3, ...]: each
entry is one contiguous array over joints and frames, which makes products seven times faster in numpy than
`matmul` on [..., 3, 3].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.skeleton import Skeleton

_PRIOR = 1e-8
"""Weight of "stay with the parent" against the bones, as a share of their squared length: decides only what
the bones leave open (a twist about a single line, bones without length).
"""

_NO_BONE = 1e-9
"""Shorter bones have no direction."""


def forward_kinematics(
    rotations: NDArray[np.floating],
    root: NDArray[np.floating],
    offsets: NDArray[np.floating],
    parents: Sequence[int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Local rotations [..., N, 3, 3], root positions [..., 3] -> joints [..., N, 3], global rotations.

    Leading dimensions of `rotations` and `root` broadcast. All joints of one depth of the tree are done in
    one call.
    """
    count = len(parents)
    if rotations.shape[-3:] != (count, 3, 3) or offsets.shape != (count, 3):
        raise UserError(
            f"{count} parents need rotations [..., {count}, 3, 3] and offsets [{count}, 3], "
            f"not {list(rotations.shape)} and {list(offsets.shape)}"
        )
    lead = np.broadcast_shapes(rotations.shape[:-3], root.shape[:-1])
    local = np.moveaxis(np.broadcast_to(rotations, (*lead, count, 3, 3)), (-2, -1, -3), (0, 1, 2))
    local = np.ascontiguousarray(local, dtype=np.float64)
    bones = np.asarray(offsets, dtype=np.float64).T.reshape(3, 1, count, *(1,) * len(lead))
    world = np.empty_like(local)
    world[:, :, 0] = local[:, :, 0]
    joints = np.empty((3, 1, count, *lead))
    joints[:, 0, 0] = np.moveaxis(np.broadcast_to(root, (*lead, 3)), -1, 0)
    for children in levels(parents):
        # Joints of one depth do not depend on each other: one product for all of them.
        above = [parents[child] for child in children]
        turned = world[:, :, above]
        world[:, :, children] = multiply(turned, local[:, :, children])
        joints[:, :, children] = joints[:, :, above] + multiply(turned, bones[:, :, children])
    return np.ascontiguousarray(np.moveaxis(joints[:, 0], (0, 1), (-1, -2))), _axes_last(world)


def joints_to_rotations(joints: NDArray[np.floating], skeleton: Skeleton) -> NDArray[np.float64]:
    """Local rotations [..., N, 3, 3] that pose `skeleton` like joints [..., N, 3] (any units).

    A joint with one child gets the smallest rotation that points the bone the right way (no twist, which
    positions do not show); pelvis, chest and wrists get the rotation that fits all their bones best, so the
    root follows hips and spine; end joints follow their parent. `forward_kinematics` of the result equals the
    joints where the bone lengths and the fixed shape of pelvis, chest and palm are the skeleton's; bones
    without length take their parent's pose.
    """
    count = len(skeleton)
    skeleton.require_joints(joints)
    parents = np.asarray(skeleton.parents)
    rest = skeleton.offsets
    bones = np.array(np.moveaxis(joints, (-1, -2), (0, 1)), dtype=np.float64)
    bones[:, 1:] -= bones[:, parents[1:]]
    lengths = np.linalg.norm(bones, axis=0)
    bones /= np.where(lengths > _NO_BONE, lengths, np.inf)

    children = [np.flatnonzero(parents == joint) for joint in range(count)]
    world = np.empty((3, 3, count + 1, *bones.shape[2:]))
    world[:, :, -1] = np.eye(3).reshape(3, 3, *(1,) * (bones.ndim - 2))  # the root's parent -1 is the world
    for level in [[0], *levels(skeleton.parents)]:
        world[:, :, level] = world[:, :, parents[level]]
        single = [joint for joint in level if len(children[joint]) == 1]
        if single:
            ends = np.concatenate([children[joint] for joint in single])
            world[:, :, single] = _swing_bones(rest[ends], bones[:, ends], world[:, :, single])
        # Several bones fix the rotation; one leaves the twist open, which stays the parent's.
        for joint in level:
            if len(children[joint]) > 1:
                ends = children[joint]
                world[:, :, joint] = _fit(rest[ends], bones[:, ends], world[:, :, joint])
    return _axes_last(multiply(world[:, :, parents].swapaxes(0, 1), world[:, :, :-1]))


def levels(parents: Sequence[int]) -> list[list[int]]:
    """Joints grouped by depth below the root, the root left out."""
    depth = [0] * len(parents)
    for joint, parent in enumerate(parents[1:], start=1):
        depth[joint] = depth[parent] + 1
    return [[j for j, d in enumerate(depth) if d == level] for level in range(1, max(depth) + 1)]


def _swing_bones(
    rest: NDArray[np.float64], bones: NDArray[np.float64], above: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Smallest changes of `above` [3, 3, J, ...] that turn `rest` [J, 3] along `bones` [3, J, ...]."""
    length = np.linalg.norm(rest, axis=-1)
    known = length > _NO_BONE
    spread = (-1, *(1,) * (bones.ndim - 2))
    unit = np.where(known[:, None], rest / np.where(known, length, 1.0)[:, None], [0.0, 1.0, 0.0])
    old = multiply(above, unit.T.reshape(3, 1, *spread))[:, 0]
    new = np.where(bones.any(axis=0) & known.reshape(spread), bones, old)
    return multiply(swing(old, new), above)


def _fit(
    rest: NDArray[np.float64], bones: NDArray[np.float64], above: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotations [3, 3, ...] that fit `rest` [C, 3] to directions `bones` [3, C, ...] best.

    What the bones leave free stays as in the parent's rotations `above` [3, 3, ...].
    """
    # Directions at the skeleton's own bone lengths: what forward kinematics can reach is what the fit weighs.
    aims = bones * np.linalg.norm(rest, axis=-1).reshape(-1, *(1,) * (bones.ndim - 2))
    moment = np.einsum("ic...,cj->...ij", aims, rest)
    moment += _PRIOR * np.square(rest).sum() * np.moveaxis(above, (0, 1), (-2, -1))
    return np.moveaxis(nearest_rotations(moment), (-2, -1), (0, 1))


def nearest_rotations(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations nearest to matrices [..., 3, 3], by least squares."""
    # Orthogonal Procrustes by numpy: `roma.special_procrustes` takes 40 ms a call, whatever the batch. An SVD
    # stays exact where bones lie in one line and a prior decides the twist.
    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    return np.asarray(left @ right)


def _axes_last(matrices: NDArray[np.floating]) -> NDArray[np.float64]:
    """[3, 3, N, ...] -> contiguous [..., N, 3, 3]."""
    return np.ascontiguousarray(np.moveaxis(matrices, (0, 1, 2), (-2, -1, -3)), dtype=np.float64)


def multiply(left: NDArray[np.floating], right: NDArray[np.floating]) -> NDArray[np.float64]:
    """Matrix product over the first two axes, [3, 3, ...] times [3, K, ...]; the rest broadcasts."""
    out = left[:, 0, None] * right[0]
    out += left[:, 1, None] * right[1]
    out += left[:, 2, None] * right[2]
    return np.asarray(out, dtype=np.float64)


def swing(old: NDArray[np.float64], new: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smallest rotation between unit vectors: `old` [3, ...] and `new` [3, ...] -> [3, 3, ...] with R old =
    new.

    Opposite vectors give half a turn about a line at right angles. The two shapes broadcast after the first
    axis.
    """
    x = old[1] * new[2] - old[2] * new[1]
    y = old[2] * new[0] - old[0] * new[2]
    z = old[0] * new[1] - old[1] * new[0]
    cosine = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
    # R = cos I + [c]x + c c^T / (1 + cos) with c = old x new. Near opposite vectors 1 + cos loses its digits,
    # but equals |c|^2 / (1 - cos); at opposite ones both are 0.
    share = 1.0 / np.maximum(1.0 + cosine, 1e-16)
    near = cosine < -0.99
    opposite = near
    if near.any():
        square = x * x + y * y + z * z
        opposite = near & (square < 1e-24)
        share[near] = (1.0 - cosine[near]) / np.maximum(square[near], 1e-24)
    out = np.empty((3, 3, *cosine.shape))
    out[0, 0] = cosine + x * x * share
    out[1, 1] = cosine + y * y * share
    out[2, 2] = cosine + z * z * share
    for row, column, product, rest in ((0, 1, x * y, z), (0, 2, x * z, -y), (1, 2, y * z, x)):
        product *= share
        out[row, column] = product - rest
        out[column, row] = product + rest
    if opposite.any():
        start = np.broadcast_to(old, (3, *cosine.shape))[:, opposite]
        spare = np.cross(start, np.eye(3)[:, np.abs(start).argmin(axis=0)], axis=0)
        spare /= np.linalg.norm(spare, axis=0)
        out[:, :, opposite] = 2.0 * spare[:, None] * spare[None] - np.eye(3)[:, :, None]
    return out
