"""Joints moved so that they are where they must be, by as little as needed and without a jump [ours].

The root's way and heading are bent between the frames in which they are known; a joint that is pinned takes
its limb along, and what the limb does not reach the rest of the body gives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.canonical import ground
from motionloom.datasets.motion.easing import eased

_PINNED, _FREE, _BENDS = 1000.0, 1.0, 0.05
"""Weights of joints: that must be somewhere, of the rest, and of knees and elbows, which may bend."""
_ROUNDS = 3
"""Rounds of aiming past a pin by as much as it was missed."""

Pinned = Mapping[tuple[int, int], Sequence[float]]
"""Places of pinned joints, in metres, by frame and joint."""


def landed(
    joints: NDArray[np.float64],
    heading: NDArray[np.float64],
    place_change: NDArray[np.complex128],
    heading_change: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joints [T, N, 3] and headings [T] after each frame is turned about its root and moved along the floor.

    Args:
        place_change: Metres, z + i x, [T].
        heading_change: Radians to the left [T].
    """
    plane = ground(joints)
    root = plane[:, :1]
    plane = root + (plane - root) * np.exp(1j * heading_change)[:, None] + place_change[:, None]
    out = np.array(joints, dtype=np.float64)
    out[..., 2] = plane.real
    out[..., 0] = plane.imag
    return out, heading + heading_change


def reached(
    figure: RigidMotion,
    pinned: Pinned,
    fixed: NDArray[np.bool_],
    blend: int,
    hold: Callable[[RigidMotion], RigidMotion],
) -> RigidMotion:
    """The figure with the pinned joints where they must be, as far as its bones reach; feet stay.

    Args:
        fixed: Joints that may not move, bool [T, N].
        blend: Frames before and after a pin in which the figure goes there and comes back; fewer where a
            fixed frame is nearer.
        hold: Puts back what is kept of a figure, bit for bit.
    """
    skeleton = figure.skeleton
    out = figure
    missing = {key: np.asarray(place) - figure.joints[key] for key, place in pinned.items()}
    pinned_joints = sorted({joint for _, joint in pinned})
    firm = np.where(fixed, _PINNED, _FREE)
    firm[
        :, [skeleton.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("ankle", "foot")]
    ] = _PINNED
    # The solver trades pins against the rest, so it falls short of them by a little. Each round aims past a
    # pin by what was missed.
    for _ in range(_ROUNDS):
        targets = figure.joints.copy()
        weights = firm.copy()
        still: NDArray[np.bool_] = np.all(fixed, axis=1)
        changes = {joint: _track(joint, missing, still, blend) for joint in pinned_joints}
        for joint in pinned_joints:
            # Elbows and knees give way, so that a hand or foot is reached by bending, not by moving the body.
            weights[:, skeleton.parents[joint]] = np.minimum(weights[:, skeleton.parents[joint]], _BENDS)
        # Fingers follow their wrist, and toes their ankle.
        nearest: list[int | None] = []
        for joint, parent in enumerate(skeleton.parents):
            above = joint if joint in changes else nearest[parent] if parent >= 0 else None
            nearest.append(above)
            if above is not None:
                targets[:, joint] += np.where(fixed[:, joint, None], 0.0, changes[above])
        weights[:, pinned_joints] = _PINNED
        weights[fixed] = _PINNED
        rows = np.flatnonzero(np.any([change.any(axis=1) for change in changes.values()], axis=0))
        turned = figure.rotations.copy()
        root = figure.root.copy()
        turned[rows], root[rows] = solve_poses(
            targets[rows], skeleton.offsets, skeleton.parents, turned[rows], root[rows], weights[rows]
        )
        out = hold(RigidMotion.posed(skeleton, turned, root, figure.joints))
        for key, place in pinned.items():
            missing[key] = missing[key] + np.asarray(place) - out.joints[key]
    return out


def _track(
    joint: int, missing: Mapping[tuple[int, int], NDArray[np.float64]], still: NDArray[np.bool_], blend: int
) -> NDArray[np.float64]:
    """Return the displacement of a joint in every frame [T, 3]: at its pins all of it, nothing `blend` frames
    away from them and where the figure must stand `still`.
    """
    knots = np.array([frame for frame, one in missing if one == joint])
    frames = len(still)
    values = np.zeros((frames, 3))
    for frame in knots:
        values[frame] = missing[frame, joint]
    known = still.copy()
    known[knots] = True
    near = np.abs(np.arange(frames)[:, None] - knots).min(axis=1)
    known |= near >= blend
    return eased(values, known)
