"""The one retargeting: rotations of a figure carried to another skeleton, twists kept **[ours]**.

Seen from the world, joint `j` of the source is turned by `S_j(t)`, in axes that are its maker's own. Ours is
turned by `S_j(t) C_j`: `C_j` leads from our rest pose (T-pose, +Z ahead) to the axes of the source, once for
the whole clip. It comes from

1. the source's rest pose, where this is a standing figure: it faces ahead and looks straight on, as ours;
2. else (Bandai-Namco, LAFAN1: all bones along one line) the mean of what positions show, taken to the nearest
   of the 24 rotations that exchange axes: makers put the axes of a joint along the bone and across it.

Limbs are then turned by the smallest rotation that lays our bone on the source's, so that every direction is
the file's. Trunks, necks and, where there is a rest pose, feet take their rest directions from the source:
a neck that leans otherwise tilts no head, and no sole. Last, `chain_solver` takes up what is left between the
joints (spines of other counts, joints that are means); ends keep the orientation of the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.body.resting_hands import relaxed_hands
from motionloom.datasets.motion.body.rigid import RigidMotion, flat_foot, measured_skeleton, with_offsets
from motionloom.datasets.motion.kinematics import (
    forward_kinematics,
    joints_to_rotations,
    nearest_rotations,
    swing,
)
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton

Floats = NDArray[np.float64]

_LIMBS = ("hip", "knee", "shoulder", "elbow")
_MEASURED = 500
"""Frames, at least, of longer clips that axes are measured on, spread evenly."""
_MEANS = 0.02
"""Weight of joints that no joint of the file stands for."""
_FIRM = 10.0
"""Weight of joints that a pelvis carries: a spine that bends far does not pull at it."""
_FEET, _KNEES = 1000.0, 0.05
"""Weights of feet that are lifted to their height, and of knees, where legs bend for it."""
_HIGH = 0.25
"""Metres above the lowest place of a foot from which its height counts for nothing."""
_BENT = 0.15
"""Sine of the angle by which an elbow must be bent, on average, to show its axis."""
_CARRIED = ("hip", "spine1", "collar")
_UPRIGHT = 0.7
"""Cosine to the vertical that the legs of a standing figure have at least; half of it is enough for neck and
head, which may lean.
"""
_AHEAD = 0.3
"""Share of a foot's bone that points ahead at least in such a figure."""
_ALONG = 0.97
"""Cosine to one of its axes of a bone that lies along it."""
_CONVENTION = 2.8
"""Trace of a turn by 26 degrees: a convention differs from what positions of a trunk show by less, 13 degrees
in recordings of Bandai-Namco.
"""
_AXES = np.array(
    [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(np.diag(signs) @ np.eye(3)[list(order)]) > 0
    ]
)
"""The 24 rotations that exchange axes [24, 3, 3]."""
_MIRRORED = np.stack(
    [
        np.diag(turned) @ _AXES @ np.diag([-1.0, 1.0, 1.0])
        for turned in product((1.0, -1.0), repeat=3)
        if np.prod(turned) < 0
    ],
    axis=1,
)
"""For each of them on the left, what the right may have: its image, with axes turned round [24, 4, 3, 3]."""
_CHAINS = (
    ("pelvis",), ("spine1",), ("spine2",), ("spine3",), ("neck", "head"),
    ("left_collar", "left_shoulder", "left_elbow", "left_wrist"), ("left_hip", "left_knee"), ("left_ankle",),
    ("left_foot",),
)  # fmt: skip
"""Joints whose axes are alike."""


@dataclass(frozen=True)
class SourceFigure:
    """Joints of one of our skeletons as a file has them: T frames, metres, Y up."""

    joints: Floats
    """[T, N, 3]."""
    turns: Floats
    """World rotations [T, N, 3, 3] of the joints that stand for them, in axes of their maker."""
    known: NDArray[np.bool_]
    """Which joints have a rotation [N]; others are means of some, or End Sites."""
    rest: Floats
    """Joints [N, 3] while all of these rotations are none."""


def carried(source: SourceFigure, skeleton: Skeleton) -> RigidMotion:
    """The motion on our joints, with the source's bones, its rotations and the twists of these."""
    parents = np.asarray(skeleton.parents)
    count = len(skeleton)
    points = np.asarray(source.joints, dtype=np.float64)
    own = measured_skeleton(points, skeleton)
    seen = slice(None, None, max(1, len(points) // _MEASURED))
    axes, standing = _axes_of(source, own, seen)
    offsets = own.offsets.copy()
    # From the root down, since hands are laid over the forearm that carries them.
    for joint in range(count):
        ends = np.flatnonzero(parents == joint)
        name = skeleton.joints[joint]
        carrier = parents[joint]
        if not source.known[joint]:
            continue
        if standing and (joint >= BODY_JOINTS or "wrist" in name) and source.known[carrier]:
            axes[joint] = axes[carrier]
        if not len(ends):
            continue
        bones = points[seen, ends] if len(ends) == 1 else points[seen][:, ends]
        bones = bones.reshape(len(bones), len(ends), 3) - points[seen, joint, None]
        local = np.median(np.einsum("tji,tcj->tci", source.turns[seen, joint], bones), axis=0)
        aims = local @ axes[joint]
        if "ankle" in name and not standing:
            offsets[ends[0]] = flat_foot(points[seen, joint], points[seen, ends[0]], own.offsets[ends[0]])
        if "wrist" in name:
            axes[joint] = axes[joint] @ _laid(own.offsets[ends], aims)
        elif joint >= BODY_JOINTS or name.endswith(_LIMBS) or ("ankle" in name and not standing):
            axes[joint] = axes[joint] @ _swing(offsets[ends[0]], aims[0])
        else:
            size = np.linalg.norm(aims, axis=-1, keepdims=True)
            length = np.linalg.norm(own.offsets[ends], axis=-1, keepdims=True)
            offsets[ends] = np.where(size > 1e-9, aims / np.maximum(size, 1e-9) * length, offsets[ends])
    own = with_offsets(own, offsets)
    return posed_by(points, source.turns @ axes, source.known, own)


def posed_by(
    joints: NDArray[np.floating], turns: Floats, known: NDArray[np.bool_], skeleton: Skeleton
) -> RigidMotion:
    """The skeleton at joints [T, N, 3] with world rotations [T, N, 3, 3] where these are known [N].

    Other joints turn as little as positions allow; twists and ends stay as they are given.
    """
    parents = np.asarray(skeleton.parents)
    world = np.array(turns, dtype=np.float64)
    for joint, parent in enumerate(parents):
        if known[joint]:
            continue
        world[:, joint] = world[:, parent] if parent >= 0 else np.eye(3)
        if len(ends := np.flatnonzero(parents == joint)) == 1:
            rest = (world[:, joint] @ skeleton.offsets[ends[0]]).T
            bone = (joints[:, ends[0]] - joints[:, joint]).T
            world[:, joint] = np.moveaxis(swing(_unit(rest), _unit(bone)), -1, 0) @ world[:, joint]
    local = _local(world, parents)
    # Joints that are means, or hang on bones that are not ours, are placed by what carries them: hips do not
    # turn away from the file's to reach them.
    targets = np.array(joints, dtype=np.float64)
    weights = np.where(known | ~np.isin(np.arange(len(parents)), parents), 1.0, _MEANS)
    for joint, name in enumerate(skeleton.joints):
        if name.endswith(_CARRIED) and known[parents[joint]]:
            targets[:, joint] = (
                targets[:, parents[joint]] + world[:, parents[joint]] @ skeleton.offsets[joint]
            )
            weights[joint] = 1.0 if parents[joint] else _FIRM
    local, root = solve_poses(targets, skeleton.offsets, skeleton.parents, local, targets[:, 0], weights)
    _, now = forward_kinematics(local, root, skeleton.offsets, skeleton.parents)
    for end in np.flatnonzero(known):
        if end not in parents:
            local[:, end] = now[:, parents[end]].swapaxes(-1, -2) @ world[:, end]
    return RigidMotion.posed(skeleton, local, root, joints)


def on_bones(motion: RigidMotion, offsets: NDArray[np.floating]) -> RigidMotion:
    """The motion on other bones [N, 3] of its joints: orientations and directions of limbs are the motion's,
    the path is scaled with the legs, and feet are as high as they were. The error is of the feet alone.
    """
    own = motion.skeleton
    skeleton = with_offsets(own, np.asarray(offsets, dtype=np.float64))
    if skeleton == own:
        return motion
    feet = np.array(
        [[own.index(f"{side}_{name}") for name in ("ankle", "foot")] for side in ("left", "right")]
    )
    _, world = forward_kinematics(motion.rotations, motion.root, own.offsets, own.parents)
    for end in range(1, len(own)):
        joint = own.parents[end]
        if own.joints[joint].endswith(_LIMBS) or joint >= BODY_JOINTS:
            world[:, joint] = world[:, joint] @ _swing(skeleton.offsets[end], own.offsets[end])
    local = _local(world, np.asarray(own.parents))
    balls = feet[:, 1]
    scale = skeleton.rest_joints[balls, 1].mean() / own.rest_joints[balls, 1].mean()
    targets, _ = forward_kinematics(local, motion.root * scale, skeleton.offsets, skeleton.parents)
    weights = np.ones(len(own))
    floor = motion.joints[:, feet[:, 1], 1].min()
    for ankle, ball in feet:
        height = motion.joints[:, ball, 1]
        near = np.clip(1 - (height - floor) / _HIGH, 0, 1)
        targets[:, [ankle, ball], 1] += (near * (height * scale - targets[:, ball, 1]))[:, None]
        weights[[ankle, ball]] = _FEET
        weights[own.parents[ankle]] = _KNEES
    local, root = solve_poses(targets, skeleton.offsets, skeleton.parents, local, targets[:, 0], weights)
    return RigidMotion.posed(skeleton, local, root, targets)


def on_one_skeleton(motions: Sequence[RigidMotion]) -> list[RigidMotion]:
    """Return the motions on one skeleton of their mean bones."""
    own = [motion.skeleton for motion in motions]
    if any(skeleton.joints != own[0].joints for skeleton in own):
        raise UserError("motions of different joints have no skeleton in common; write one file for each")
    if all(skeleton == own[0] for skeleton in own):
        return list(motions)
    mean = np.mean([skeleton.offsets for skeleton in own], axis=0)
    return [on_bones(motion, mean) for motion in motions]


def with_hands(figure: RigidMotion) -> RigidMotion:
    """A figure without fingers, with hands at rest."""
    whole = Skeleton.named("smplx52")
    body = figure.skeleton
    frames = len(figure.root)
    sizes = []
    local = relaxed_hands()
    for side in ("left", "right"):
        wrist = whole.index(f"{side}_wrist")
        forearm = np.linalg.norm(np.stack([body.offsets[wrist], whole.offsets[wrist]]), axis=-1)
        sizes += [forearm[0] / forearm[1]] * (len(local) // 2)
    fingers = whole.offsets[BODY_JOINTS:] * np.array(sizes)[:, None]
    skeleton = with_offsets(whole, np.concatenate([body.offsets, fingers]))
    rotations = np.concatenate([figure.rotations, np.broadcast_to(local, (frames, *local.shape))], axis=1)
    posed = RigidMotion.posed(skeleton, rotations, figure.root, np.zeros((frames, len(whole), 3)))
    return replace(posed, error=figure.error)


def _axes_of(source: SourceFigure, own: Skeleton, seen: slice) -> tuple[Floats, bool]:
    """From our rest pose to the axes of the source's joints [N, 3, 3]; whether its rest pose says them."""
    ahead = upright_turn(source.rest, own)
    if _stands(source.rest @ ahead.T, own):
        return np.repeat(ahead.T[None], len(own), axis=0), True
    points = source.joints[seen]
    turns = source.turns[seen]
    _, shown = forward_kinematics(joints_to_rotations(points, own), points[:, 0], own.offsets, own.parents)
    # Positions say nothing of a head: on the whole it looks where the chest does.
    shown[:, own.index("head")] = shown[:, own.index("spine3")]
    axes = nearest_rotations(np.einsum("tnji,tnjk->nik", turns, shown))
    # An elbow bends one way only, which shows how the upper arm is twisted.
    for side in ("left", "right"):
        arm = shoulder, elbow, wrist = [
            own.index(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist")
        ]
        upper, fore = (_unit((points[:, b] - points[:, a]).T) for a, b in ((shoulder, elbow), (elbow, wrist)))
        bone, bent = (np.einsum("tji,jt->i", turns[:, shoulder], way) / len(points) for way in (upper, fore))
        bent -= (bent @ bone) * bone
        if np.linalg.norm(bent) > _BENT:
            axes[arm] = _laid(np.stack([own.offsets[elbow], [0.0, 0.0, 1.0]]), np.stack([bone, bent]))
    usable = source.known.copy()
    for joint in range(len(own)):
        ends = [child for child, parent in enumerate(own.parents) if parent == joint]
        if len(ends) == 1:
            way = np.einsum("tji,tj->ti", turns[:, joint], points[:, ends[0]] - points[:, joint])
            # Axes that are not along the bone are nobody's convention.
            usable[joint] &= np.abs(_unit(np.median(way, axis=0))).max() > _ALONG
    for chain in _CHAINS:
        here = [own.index(name) for name in chain]
        there = own.mirror[here].tolist()
        if not usable[[*here, *there]].all():
            continue
        scores = np.einsum("kij,ij->k", _AXES, axes[here].sum(axis=0))
        if there[0] == here[0]:
            # Positions show a trunk well: one that fits no such axes has its own (trace of a rotation).
            if len(here) > 1 or scores.max() > _CONVENTION:
                axes[here] = _AXES[scores.argmax()]
            continue
        both = scores[:, None] + np.einsum("kdij,ij->kd", _MIRRORED, axes[there].sum(axis=0))
        best = np.unravel_index(int(both.argmax()), both.shape)
        axes[here] = _AXES[best[0]]
        axes[there] = _MIRRORED[best]
    return axes, False


def upright_turn(rest: Floats, skeleton: Skeleton) -> Floats:
    """The rotation that turns a rest pose to stand upright and look ahead; between axes where it can be."""
    names = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
    hips, shoulders = np.split(rest[[skeleton.index(name) for name in names]], 2)
    side = _unit(hips[0] - hips[1] + shoulders[0] - shoulders[1])
    up = shoulders.mean(axis=0) - hips.mean(axis=0)
    up = _unit(up - (up @ side) * side)
    turn = np.stack([side, up, np.cross(side, up)])
    nearest = _AXES[np.einsum("kij,ij->k", _AXES, turn).argmax()]
    return nearest if np.trace(nearest @ turn.T) > 2.6 else turn  # 37 degrees


def _stands(rest: Floats, skeleton: Skeleton) -> bool:
    """Whether a rest pose [N, 3], Y up and +Z ahead, is a standing figure."""
    bones = _unit(skeleton.bones(rest).T).T

    def bone(name: str) -> Floats:
        return np.asarray(bones[skeleton.index(name)])

    legs = [bone(f"{side}_{joint}") for side in ("left", "right") for joint in ("knee", "ankle")]
    feet = [bone(f"{side}_foot")[2] for side in ("left", "right")]
    upright = min(2 * bone("head")[1], 2 * bone("neck")[1], *(-leg[1] for leg in legs))
    return bool(upright > _UPRIGHT and min(feet) > _AHEAD)


def _laid(bones: Floats, aims: Floats) -> Floats:
    """The rotation that lays bones [C, 3] over aims [C, 3], direction by direction."""
    return nearest_rotations(_unit(aims.T) @ _unit(bones.T).T)


def _swing(bone: Floats, aim: Floats) -> Floats:
    """The smallest rotation that turns a bone where it aims; none for those without length."""
    if not (bone.any() and aim.any()):
        return np.eye(3)
    return swing(_unit(bone)[:, None], _unit(aim)[:, None])[..., 0]


def _unit(vectors: Floats) -> Floats:
    """Unit vectors of [3, ...]."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=0), 1e-12))


def _local(world: Floats, parents: NDArray[np.int64]) -> Floats:
    """Local rotations of world rotations [T, N, 3, 3]."""
    out = world.copy()
    out[:, 1:] = world[:, parents[1:]].swapaxes(-1, -2) @ world[:, 1:]
    return out
