"""Poses of a rigid skeleton nearest to given joint positions: Gauss-Newton over the tree, all frames at once.

Unknown are the root's place and the world rotation of every joint that has children. One step of Gauss-Newton
on the squared distances has a normal matrix of 3 (J + 1) unknowns a frame; it is never built. Seen from a
joint, all that hangs below is one quadratic function of that joint's displacement, so the tree is eliminated
from the leaves to the root and solved back **[ours]**: exact, and linear in the number of joints, where a
dense solver is cubic.

With `b_c` the bone to child `c` in the world, a small rotation `w` of joint `a` and a displacement `d_a`
give `d_c = d_a + w x b_c`. The cost of everything at and below `c` is `d_c' H_c d_c / 2 + g_c' d_c`; its
minimum over `w` is again of this form in `d_a`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.kinematics import forward_kinematics, levels

Floats = NDArray[np.float64]
Rows = NDArray[np.int64] | slice

_STEPS = 30
_CHUNK = 2048
"""Frames solved together: frames are independent, and so memory stays bounded for motions of any length."""
_STILL = 1e-10
"""A frame whose cost (square metres) falls by less, or by less than a millionth, is done."""
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-8, 1e4
"""Damping (Levenberg-Marquardt), as a share of the bones' squared lengths; decides the twist about single
bones, which no position determines: it stays as at the start."""


def solve_poses(
    targets: NDArray[np.floating],
    offsets: NDArray[np.floating],
    parents: Sequence[int],
    rotations: NDArray[np.floating],
    root: NDArray[np.floating],
    weights: NDArray[np.floating] | None = None,
) -> tuple[Floats, Floats]:
    """Local rotations [T, N, 3, 3] and root [T, 3] whose joints are nearest to `targets` [T, N, 3] (metres).

    `offsets` [N, 3] are the bones. `rotations` and `root` start the search; joints without children keep
    their local rotations. `weights` [T, N] or [N] say how much each squared distance counts (default 1).
    """
    frames, count = targets.shape[:2]
    shares = np.broadcast_to(np.ones(count) if weights is None else weights, (frames, count))
    turned = np.empty((frames, count, 3, 3))
    placed = np.empty((frames, 3))
    for start in range(0, frames, _CHUNK):
        rows = slice(start, start + _CHUNK)
        solver = _Solver(targets[rows], offsets, parents, shares[rows])
        turned[rows], placed[rows] = solver.solve(rotations[rows], root[rows])
    return turned, placed


class _Solver:
    """Arrays are joint-first, [N, T, ...]."""

    def __init__(
        self,
        targets: NDArray[np.floating],
        offsets: NDArray[np.floating],
        parents: Sequence[int],
        weights: NDArray[np.floating],
    ) -> None:
        self.targets = np.ascontiguousarray(targets.swapaxes(0, 1), dtype=np.float64)
        self.offsets = np.asarray(offsets, dtype=np.float64)
        self.parents = parents
        self.weights = np.ascontiguousarray(weights.T, dtype=np.float64)
        self.levels: list[tuple[list[int], list[int], list[int]]] = []
        """Joints with children, by depth; their children, and the row of each child's parent."""
        for level in [[0], *levels(parents)]:
            if joints := [joint for joint in level if joint in parents]:
                children = [child for child, above in enumerate(parents) if above in joints]
                self.levels.append((joints, children, [joints.index(parents[child]) for child in children]))
        self.inner = sorted(joint for joints, _, _ in self.levels for joint in joints)

    def solve(self, rotations: NDArray[np.floating], root: NDArray[np.floating]) -> tuple[Floats, Floats]:
        """Levenberg-Marquardt, each frame with its own damping."""
        local = np.array(rotations, dtype=np.float64)
        place = np.array(root, dtype=np.float64)
        joints, world = forward_kinematics(local, place, self.offsets, self.parents)
        cost = self._cost(joints, slice(None))
        damping = np.full(len(local), _FIRST_DAMPING)
        open_frames = np.arange(len(local))
        for _ in range(_STEPS):
            if not len(open_frames):
                break
            rows = open_frames
            step, turn = self._step(joints[rows], world[rows], damping[rows], rows)
            new_world = world[rows]
            new_world[:, self.inner] = turn @ new_world[:, self.inner]
            new_local = self._local(new_world, local[rows])
            new_place = place[rows] + step
            new_joints, new_world = forward_kinematics(new_local, new_place, self.offsets, self.parents)
            new_cost = self._cost(new_joints, rows)
            # A step that makes a frame worse is not taken but tried again, shorter, by more damping.
            better = new_cost <= cost[rows]
            gain = cost[rows] - new_cost
            small = np.abs(gain) < _STILL + 1e-6 * cost[rows]
            taken = rows[better]
            for kept, new in (
                (joints, new_joints), (world, new_world), (local, new_local), (place, new_place),
                (cost, new_cost),
            ):  # fmt: skip
                kept[taken] = new[better]
            damping[rows] *= np.where(better, 0.1, 10.0)
            np.clip(damping, _LEAST_DAMPING, _MOST_DAMPING, out=damping)
            open_frames = rows[~small & (damping[rows] < _MOST_DAMPING)]
        return local, place

    def _cost(self, joints: Floats, rows: Rows) -> Floats:
        square = np.square(joints - self.targets[:, rows].swapaxes(0, 1)).sum(axis=-1)
        return np.asarray((square * self.weights[:, rows].T).sum(axis=-1) / 2, dtype=np.float64)

    def _local(self, world: Floats, before: Floats) -> Floats:
        """Local rotations of world rotations; the ends' stay as they were.

        Products of products drift away from rotations, at each step and down the chain by more and more, so
        one step of Newton's iteration takes each back to the nearest rotation.
        """
        local = before.copy()
        for joint in self.inner:
            above = self.parents[joint]
            turned = world[:, joint]
            own = turned if above < 0 else world[:, above].swapaxes(-1, -2) @ turned
            local[:, joint] = own @ (1.5 * np.eye(3) - 0.5 * own.swapaxes(-1, -2) @ own)
        return local

    def _step(self, joints: Floats, world: Floats, damping: Floats, rows: Rows) -> tuple[Floats, Floats]:
        """One step of the given frames: the root's displacement [t, 3] and turns [t, J, 3, 3] of `inner`."""
        from scipy.spatial.transform import Rotation

        points = joints.swapaxes(0, 1)
        frames = len(joints)
        weight = self.weights[:, rows]
        hessian = weight[..., None, None] * np.eye(3)
        gradient = weight[..., None] * (points - self.targets[:, rows])
        solved: list[tuple[Floats, Floats, Floats]] = []
        # From the leaves up: each joint's turn is eliminated, and what is left of its children's cost, a
        # quadratic function of the joint's own displacement, is added to its own.
        for joints_here, children, owner in reversed(self.levels):
            bones = points[children] - points[np.asarray(joints_here)[owner]]
            lever = _skew(bones)
            pulled = lever @ hessian[children]
            firm = _sum_by(-(pulled @ lever), owner)
            mixed = _sum_by(pulled, owner)
            force = _sum_by((lever @ gradient[children][..., None])[..., 0], owner)
            size = _sum_by(np.square(bones).sum(axis=-1) * weight[children], owner) + 1e-12
            firm += (damping * size)[..., None, None] * np.eye(3)
            both = np.linalg.solve(firm, np.concatenate([mixed, force[..., None]], axis=-1))
            ratio = both[..., :3]
            rest = both[..., 3]
            across = mixed.swapaxes(-1, -2)
            hessian[joints_here] += _sum_by(hessian[children], owner) - across @ ratio
            gradient[joints_here] += _sum_by(gradient[children], owner) - (across @ rest[..., None])[..., 0]
            solved.append((bones, ratio, rest))
        move = np.zeros_like(points)
        # The root is as firm as its own weight; a root that counts for nothing still hangs on its bones.
        move[0] = -np.linalg.solve(hessian[0] + 1e-12 * np.eye(3), gradient[0][..., None])[..., 0]
        spin = np.zeros_like(points)
        # From the root down: displacements are known now, so turns follow, and from these the children's.
        for (joints_here, children, owner), (bones, ratio, rest) in zip(
            self.levels, reversed(solved), strict=True
        ):
            turned = -((ratio @ move[joints_here][..., None])[..., 0] + rest)
            spin[joints_here] = turned
            above = np.asarray(joints_here)[owner]
            move[children] = move[above] + np.cross(turned[owner], bones)
        vectors = spin[self.inner].swapaxes(0, 1)
        # Beyond a radian the linear model means nothing; the next steps go on from there.
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        vectors = vectors / np.maximum(length, 1.0)
        turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, -1, 3, 3)
        return move[0], turns


def _sum_by(values: Floats, owner: Sequence[int]) -> Floats:
    """Sums [J, ...] of values [C, ...] by owner."""
    out = np.zeros((max(owner) + 1, *values.shape[1:]))
    for row, value in zip(owner, values, strict=True):
        out[row] += value
    return out


def _skew(vectors: Floats) -> Floats:
    """Matrices [..., 3, 3] with S v = vector x v."""
    out = np.zeros((*vectors.shape, 3))
    x = vectors[..., 0]
    y = vectors[..., 1]
    z = vectors[..., 2]
    out[..., 0, 1] = -z
    out[..., 0, 2] = y
    out[..., 1, 2] = -x
    out[..., 1, 0] = z
    out[..., 2, 0] = -y
    out[..., 2, 1] = x
    return out
