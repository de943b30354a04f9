"""One rigid skeleton for a whole motion: constant bones, a root and rotations, from joints that may stretch.

Generated features hold positions, and nothing in them keeps bones at one length: within a clip of a small
model a forearm changes by half. Tools that move skeletons (BVH, GLB, SMPL-X) cannot show that, and no body
does it. So what is *shown* is a fitted figure, the same in every output; what is *measured* (evaluation,
metrics) stays the features' own joints.

The skeleton: each bone has the median length of the clip, and the fixed shapes of pelvis, chest and palms,
whose joints carry several bones, are the clip's own too. Then `chain_solver` poses it: the frames' root and
rotations with the least squared distance to the joints.

Twist about a bone, which positions do not show, is as in the parent; of the twist that a palm shows, the
forearm takes half, as forearms do **[ours]**. Rotations that are known (raw SMPL parameters) come in as the
start and keep their twist. The `rotations_6d` of the h3d family know none: they are computed from positions
by the smallest turn (h3d.py), so they would add nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.canonical import ground, mirror, resample, resample_quaternions
from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton

Floats = NDArray[np.float64]

_NO_BONE = 1e-9
_ROUNDS = 6
"""Rounds of "turn to the bones, average the bones" for pelvis, chest and palms; a few settle it."""
_MEASURED = 500
"""Frames, at least, of longer motions that the shapes are measured on, spread evenly."""
_BUILT_ALIKE = 0.15
"""Mean difference of the logarithms of bone lengths up to which two figures are built alike: bodies of SMPL
differ by half of it, skeletons of other makers by twice as much."""
_UPRIGHT = 0.8
"""Cosine of the angle up to which a chest is upright."""
_STANDS = 0.3
"""Share of the frames, those with the lowest ankle, in which a foot is taken to stand."""
_FOREARM_SHARE = 0.5
"""Share of a hand's twist that the forearm takes."""


@dataclass(frozen=True)
class FitError:
    """Distances between the fitted joints and those they were fitted to, millimetres."""

    mean_mm: float
    max_mm: float

    @staticmethod
    def between(fitted: NDArray[np.floating], joints: NDArray[np.floating]) -> FitError:
        """Over all frames and joints [T, N, 3], metres."""
        away = np.linalg.norm(fitted - joints, axis=-1) * 1000
        return FitError(float(away.mean()), float(away.max()))

    def __str__(self) -> str:
        return f"{self.mean_mm:.1f} mm on average, {self.max_mm:.0f} mm at most"


@dataclass(frozen=True)
class RigidMotion:
    """A motion of constant bones: T frames of N joints."""

    skeleton: Skeleton
    """Names, parents, and the motion's own rest offsets in metres: T-pose, +Z ahead, left at +X."""
    rotations: Floats
    """Local rotations [T, N, 3, 3] against the rest pose, child frame to parent frame."""
    root: Floats
    """Positions [T, 3] of joint 0 in metres."""
    joints: Floats
    """Positions [T, N, 3] in metres, by forward kinematics of the above."""
    error: FitError
    """Against the joints that came in."""

    @staticmethod
    def posed(
        skeleton: Skeleton, rotations: Floats, root: Floats, joints: NDArray[np.floating]
    ) -> RigidMotion:
        """A motion of given rotations, compared with `joints` [T, N, 3]."""
        shown, _ = forward_kinematics(rotations, root, skeleton.offsets, skeleton.parents)
        return RigidMotion(skeleton, rotations, root, shown, FitError.between(shown, joints))


def fit_rigid(
    joints: NDArray[np.floating], skeleton: Skeleton, *, rotations: NDArray[np.floating] | None = None
) -> RigidMotion:
    """The rigid motion nearest to joints [T, N, 3] in metres.

    `skeleton` names the joints and gives the rest directions. `rotations` [T, N, 3, 3] are local rotations
    where they are known: the search starts there.
    """
    wanted = (len(skeleton), 3)
    if joints.ndim != 3 or joints.shape[1:] != wanted or not len(joints):
        raise UserError(
            f"skeleton {skeleton.name} needs joints [T, {wanted[0]}, 3] with T > 0, not {list(joints.shape)}"
        )
    if not np.isfinite(joints).all():
        raise UserError("joints hold NaN or infinite values: no skeleton can be fitted to them")
    if rotations is not None and rotations.shape != (*joints.shape, 3):
        raise UserError(f"rotations {list(rotations.shape)} do not fit joints {list(joints.shape)}")
    points = np.asarray(joints, dtype=np.float64)
    if rotations is None:
        own = measured_skeleton(points, skeleton)
        start = joints_to_rotations(points, own)
    else:
        own = skeleton.with_lengths_of(points)
        start = np.asarray(rotations, dtype=np.float64)
    turned, root = solve_poses(points, own.offsets, own.parents, start, points[:, 0])
    if rotations is None:
        turned = share_twist(turned, own)
    return RigidMotion.posed(own, turned, root, points)


def measured_skeleton(joints: NDArray[np.floating], skeleton: Skeleton) -> Skeleton:
    """The skeleton with the bones of a motion [T, N, 3]: median lengths, and its own pelvis, chest and palms.

    Bones of joints with one child keep the rest pose's direction, so that the rest stays a T-pose.
    """
    from scipy.spatial.transform import Rotation

    points = np.asarray(joints, dtype=np.float64)
    parents = np.asarray(skeleton.parents)
    own = skeleton.with_lengths_of(points)
    # Medians settle long before that; motions of many minutes would take as long again as their poses.
    points = points[:: max(1, len(points) // _MEASURED)]
    lengths = np.linalg.norm(own.offsets, axis=-1, keepdims=True)
    forks = [j for j in range(len(skeleton)) if (parents == j).sum() > 1]
    bones = points.copy()
    bones[:, 1:] -= points[:, parents[1:]]
    offsets = own.offsets.copy()
    # The shape of a pelvis is the median of its bones seen from the pelvis, whose rotation depends on the
    # shape: alternate until both agree.
    for _ in range(_ROUNDS):
        turned = joints_to_rotations(points, own)
        _, world = forward_kinematics(turned, points[:, 0], own.offsets, own.parents)
        for joint in forks:
            ends = np.flatnonzero((parents == joint) & (lengths[:, 0] > _NO_BONE))
            seen = np.einsum("tji,tcj->tci", world[:, joint], bones[:, ends])
            middle = np.median(seen, axis=0)
            if len(ends):  # the bones as a whole lie over their rest offsets as well as they can
                offsets[ends] = Rotation.align_vectors(skeleton.offsets[ends], middle)[0].apply(middle)
        size = np.linalg.norm(offsets, axis=-1, keepdims=True)
        offsets *= lengths / np.where(size > _NO_BONE, size, 1.0)
        own = with_offsets(skeleton, offsets)
    return _leaning(points, own, skeleton)


def _leaning(points: Floats, own: Skeleton, skeleton: Skeleton) -> Skeleton:
    """Of a figure that is not built as `skeleton`: with the lean of its neck and the steepness of its feet.

    Nobody sees a head's pitch in positions. With our neck's lean, a figure whose neck leans less looks up.
    """
    lengths, ours = (np.linalg.norm(one.offsets[1:BODY_JOINTS], axis=-1) for one in (own, skeleton))
    ratio = np.log(np.maximum(lengths, _NO_BONE) / ours)
    if np.abs(ratio - np.median(ratio)).mean() < _BUILT_ALIKE:
        return own
    from scipy.spatial.transform import Rotation

    offsets = own.offsets.copy()
    chest, neck, head = (own.index(name) for name in ("spine3", "neck", "head"))
    _, world = forward_kinematics(joints_to_rotations(points, own), points[:, 0], own.offsets, own.parents)
    # On the whole, whoever is upright looks straight on.
    upright = world[:, chest, 1, 1] > _UPRIGHT
    ahead = world[upright, chest, :, 2]
    level = Rotation.from_euler("y", np.arctan2(ahead[:, 0], ahead[:, 2])[:, None]).as_matrix()
    way = (points[:, head] - points[:, neck])[upright]
    lean = np.median(np.einsum("tji,tj->ti", level, way), axis=0) if upright.any() else np.zeros(3)
    if lean.any():
        offsets[head] = lean / np.linalg.norm(lean) * np.linalg.norm(offsets[head])
    for side in ("left", "right"):
        ankle = own.index(f"{side}_ankle")
        ball = own.index(f"{side}_foot")
        offsets[ball] = flat_foot(points[:, ankle], points[:, ball], offsets[ball])
    return with_offsets(own, offsets)


def flat_foot(ankle: Floats, ball: Floats, bone: Floats) -> Floats:
    """The bone [3] from ankle to ball, as steep as between `ankle` and `ball` [T, 3] of a standing foot: one
    whose ball is not above its ankle. The bone itself where none stands.
    """
    low = (ankle[:, 1] <= np.quantile(ankle[:, 1], _STANDS)) & (ball[:, 1] <= ankle[:, 1])
    if not low.any():
        return bone
    way = ball[low] - ankle[low]
    size = float(np.linalg.norm(bone))
    length = np.linalg.norm(way, axis=-1)
    steep = float(np.median(way[:, 1] / np.where(length > _NO_BONE, length, np.inf)))
    across = np.array([bone[0], 0.0, bone[2]])
    across *= np.sqrt(1 - steep**2) / max(float(np.linalg.norm(across)), _NO_BONE)
    return np.asarray(size * np.array([across[0], steep, across[2]]))


def share_twist(rotations: Floats, skeleton: Skeleton) -> Floats:
    """Local rotations [T, N, 3, 3] of the same joints, with half of each hand's twist given to its forearm.

    Turning a forearm about itself moves no joint, and the hand is turned back by as much.
    """
    from scipy.spatial.transform import Rotation

    out = rotations.copy()
    for side in ("left", "right"):
        elbow = skeleton.index(f"{side}_elbow")
        wrist = skeleton.index(f"{side}_wrist")
        bone = skeleton.offsets[wrist]
        if wrist not in skeleton.parents or not bone.any():
            continue
        axis = bone / np.linalg.norm(bone)
        x, y, z, w = Rotation.from_matrix(out[:, wrist]).as_quat().T
        twist = 2 * np.arctan2(np.stack([x, y, z], -1) @ axis, w)
        # The angle is known but for whole turns: the nearest to the frame before, else forearms would spin.
        twist = np.unwrap(np.remainder(twist + np.pi, 2 * np.pi) - np.pi)
        twist -= 2 * np.pi * np.round(np.median(twist) / (2 * np.pi))
        share = Rotation.from_rotvec(_FOREARM_SHARE * twist[:, None] * axis).as_matrix()
        out[:, elbow] = out[:, elbow] @ share
        out[:, wrist] = share.swapaxes(-1, -2) @ out[:, wrist]
    return out


def with_offsets(skeleton: Skeleton, offsets: NDArray[np.floating]) -> Skeleton:
    """The skeleton with other rest offsets [N, 3]."""
    return replace(skeleton, rest=tuple((float(x), float(y), float(z)) for x, y, z in offsets))


def moved(figure: RigidMotion, turn: float, place: complex, height: float) -> RigidMotion:
    """The figure turned to the left about the origin, in radians, and then moved."""
    from scipy.spatial.transform import Rotation

    def put(points: Floats) -> Floats:
        plane = ground(points) * np.exp(1j * turn) + place
        return np.stack([plane.imag, points[..., 1] + height, plane.real], axis=-1)

    rotations = figure.rotations.copy()
    rotations[:, 0] = Rotation.from_euler("y", turn).as_matrix() @ rotations[:, 0]
    return replace(figure, rotations=rotations, root=put(figure.root), joints=put(figure.joints))


def mirrored(figure: RigidMotion) -> RigidMotion:
    """The figure's mirror image: left and right swapped, x negated."""
    skeleton = figure.skeleton
    flip = np.array([-1.0, 1.0, 1.0])
    swapped = with_offsets(skeleton, skeleton.offsets[skeleton.mirror] * flip)
    rotations = figure.rotations[:, skeleton.mirror] * np.outer(flip, flip)
    return RigidMotion.posed(swapped, rotations, figure.root * flip, mirror(figure.joints, skeleton))


def at_rate(figure: RigidMotion, fps_in: float, fps_out: float) -> RigidMotion:
    """The figure at another frame rate."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(figure.rotations.reshape(-1, 3, 3)).as_quat()
    turns = resample_quaternions(turns.reshape(*figure.rotations.shape[:2], 4), fps_in, fps_out)
    rotations = Rotation.from_quat(turns.reshape(-1, 4)).as_matrix().reshape(*turns.shape[:2], 3, 3)
    root, joints = (resample(one, fps_in, fps_out) for one in (figure.root, figure.joints))
    return RigidMotion.posed(figure.skeleton, rotations, root, joints)
