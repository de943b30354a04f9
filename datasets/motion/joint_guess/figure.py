"""A foreign figure as a guess sees it: names, tree, and some poses. Nothing depends on its unit or up axis.

The poses are frames of the clip and not the OFFSETs: many tools (LAFAN1, Bandai-Namco, BONES) write all bones
along one axis, so that the rest pose is no figure at all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.bvh import BvhMotion
from motionloom.datasets.motion.joint_guess.names import JointName, read_names

POSES = 16
"""Frames looked at, spread over the clip [ours]."""

SAME_PLACE = 2e-3
"""Joints nearer to each other than this share of the figure's extent are one place (3 mm) [ours]."""


@dataclass(frozen=True)
class Figure:
    """Joints of one clip; parents come before children."""

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    poses: NDArray[np.float64]
    """Positions [K, N, 3] in some frames of the clip."""

    @staticmethod
    def of(motion: BvhMotion) -> Figure:
        """The figure of a clip."""
        chosen = np.unique(np.linspace(0, motion.frames - 1, POSES).round().astype(int))
        few = replace(motion, values=motion.values[chosen])
        return Figure(motion.joints, motion.parents, few.positions())

    @cached_property
    def names(self) -> tuple[JointName, ...]:
        """The joints' names, read."""
        return read_names(self.joints)

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """Children of every joint, spare ones left out."""
        found: list[list[int]] = [[] for _ in self.joints]
        for joint, parent in enumerate(self.parents):
            if parent >= 0 and not self.names[joint].spare:
                found[parent].append(joint)
        return tuple(tuple(joints) for joints in found)

    @cached_property
    def extent(self) -> float:
        """Largest side of the box around the figure, median over the poses."""
        return float(np.median(np.ptp(self.poses, axis=1).max(axis=-1)))

    def length(self, a: int, b: int) -> float:
        """Distance of two joints, median over the poses."""
        return float(np.median(np.linalg.norm(self.poses[:, a] - self.poses[:, b], axis=-1)))

    def coincide(self, a: int, b: int) -> bool:
        """Whether two joints lie on each other."""
        return self.length(a, b) < SAME_PLACE * self.extent

    def ancestors(self, joint: int) -> list[int]:
        """The joint, its parent, and so on to the root."""
        out = []
        while joint >= 0:
            out.append(joint)
            joint = self.parents[joint]
        return out

    def common_ancestor(self, joints: list[int]) -> int:
        """The deepest joint above all of these, or one of them."""
        shared = set.intersection(*(set(self.ancestors(joint)) for joint in joints))
        return max(shared, key=lambda joint: len(self.ancestors(joint)))

    def path(self, above: int, below: int) -> tuple[int, ...]:
        """Joints from `above` (left out) down to `below`; empty when it is not above it."""
        up = self.ancestors(below)
        return tuple(reversed(up[: up.index(above)])) if above in up else ()

    def apart(self, above: int, joints: tuple[int, ...]) -> tuple[int, ...]:
        """A path without the joints that lie on the one before them (or on `above`)."""
        out = [above]
        for joint in joints:
            if not self.coincide(joint, out[-1]):
                out.append(joint)
        return tuple(out[1:])

    def main_chain(self, joint: int) -> tuple[int, ...]:
        """The joint and, child after child, the way that reaches farthest; joints on each other once."""
        out = [joint]
        while self.children[out[-1]]:
            out.append(max(self.children[out[-1]], key=lambda child: (self._reach[child], -child)))
        # Of joints in one place the last counts: the bone begins there.
        return tuple(a for a, b in zip(out, [*out[1:], -1], strict=True) if b < 0 or not self.coincide(a, b))

    @cached_property
    def _reach(self) -> list[float]:
        """Of every joint, the longest way from its parent to an end."""
        out = [0.0] * len(self.joints)
        for joint in reversed(range(len(self.joints))):
            below = max((out[child] for child in self.children[joint]), default=0.0)
            parent = self.parents[joint]
            out[joint] = below + (self.length(joint, parent) if parent >= 0 else 0.0)
        return out
