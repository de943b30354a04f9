"""Which two joints of a figure changed places: what a joint map with two swapped rows leaves in the motion.

A wrong row shows itself without any knowledge of the skeleton it came from, in four ways that need neither
the length unit nor the upward axis:

- bones keep their length, since bodies are rigid;
- both arms and both legs are equally long;
- left joints are on the left of right ones;
- along the spine, joints that are further apart in the chain are further apart in space.

The four add up to a strain that is 0 for a body. Every pair of joints is exchanged in turn, and the exchange
that takes most of the strain away is the answer, unless it takes too little, or another does as well. Lengths
of bones are not compared with a person's: other skeletons place spine and collars elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import LEFT_HIP, LEFT_SHOULDER, RIGHT_HIP, RIGHT_SHOULDER
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton

LEAST_GAIN = 0.08
"""Strain that an exchange must take away. On real clips the weakest of all 231 exchanges (ankle and foot of
one leg) makes 0.11, and right maps have less than 0.001."""

LEAST_MARGIN = 0.015
"""How much better than the next best exchange it must be; the closest races on real clips of people who
hardly move are 0.02."""

_MOST_RIGID = 0.5
"""A bone counts as this elastic at most, or one joint in a wrong place would outweigh all else."""

_FRAMES = 200
"""Frames that are looked at, over all clips."""

_NAMED = Skeleton.named("smpl22")
_PARENTS = np.array(_NAMED.parents[1:])
_LEFT = np.array([i for i, name in enumerate(_NAMED.joints) if name.startswith("left_")])
_RIGHT = np.array([_NAMED.index(_NAMED.joints[i].replace("left_", "right_")) for i in _LEFT])
_SPINE = [_NAMED.index(name) for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")]


@dataclass(frozen=True)
class Swap:
    """Two joints of the body that stand in each other's place."""

    first: int
    second: int

    @property
    def names(self) -> tuple[str, str]:
        """Of the joints."""
        return _NAMED.joints[self.first], _NAMED.joints[self.second]

    def undo(self, joints: NDArray[Any]) -> NDArray[Any]:
        """Joints [..., N, 3] with the two exchanged."""
        order = np.arange(joints.shape[-2])
        order[[self.first, self.second]] = self.second, self.first
        return np.asarray(joints[..., order, :])


def find_swap(clips: Sequence[NDArray[Any]]) -> Swap | None:
    """The two joints that were swapped in clips of joints [T, N, 3]; None where nothing says so clearly."""
    if not clips:
        return None
    each = max(2, _FRAMES // len(clips))
    chosen = [
        np.asarray(clip[np.linspace(0, len(clip) - 1, min(each, len(clip))).astype(int), :BODY_JOINTS], float)
        for clip in clips
    ]
    body = _Body.of(chosen)
    order = np.arange(BODY_JOINTS)
    now = body.strain(order)
    if now < LEAST_GAIN:
        return None
    gains: list[tuple[float, int, int]] = []
    for first, second in combinations(range(BODY_JOINTS), 2):
        other = order.copy()
        other[[first, second]] = second, first
        gains.append((now - body.strain(other), first, second))
    best, next_best = sorted(gains, reverse=True)[:2]
    if best[0] < max(LEAST_GAIN, now / 2) or best[0] - next_best[0] < LEAST_MARGIN:
        return None
    return Swap(best[1], best[2])


@dataclass(frozen=True)
class _Body:
    """Frames of all clips, and the distances between joints."""

    joints: NDArray[np.float64]
    """[T, 22, 3]"""
    mean: NDArray[np.float64]
    """Distance of every two joints [22, 22]: mean over the frames of a clip, then over clips."""
    deviation: NDArray[np.float64]
    """How much it changes within a clip, likewise."""

    @staticmethod
    def of(clips: Sequence[NDArray[np.float64]]) -> _Body:
        """From joints [T, 22, 3] a clip."""
        distances = [np.linalg.norm(clip[:, :, None] - clip[:, None], axis=-1) for clip in clips]
        return _Body(
            np.concatenate(clips),
            np.mean([d.mean(axis=0) for d in distances], axis=0),
            np.mean([d.std(axis=0) for d in distances], axis=0),
        )

    def strain(self, order: NDArray[np.int64]) -> float:
        """How little the joints, taken in this order, behave like a body; 0 for one that does."""
        ends, starts = order[1:], order[_PARENTS]
        bones = np.maximum(self.mean[ends, starts], 1e-6)
        elastic = np.minimum(self.deviation[ends, starts] / bones, _MOST_RIGID).sum()
        uneven = np.abs(np.log(bones[_LEFT - 1] / bones[_RIGHT - 1])).sum() / 2
        body = self.joints[:, order]
        side = body[:, LEFT_HIP] - body[:, RIGHT_HIP] + body[:, LEFT_SHOULDER] - body[:, RIGHT_SHOULDER]
        side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
        apart = body[:, _LEFT] - body[:, _RIGHT]
        reach = np.maximum(np.linalg.norm(apart, axis=-1).mean(axis=0), 1e-9)
        crossed = np.maximum(0.0, -np.einsum("tpk,tk->tp", apart, side).mean(axis=0) / reach).sum()
        return float(elastic + uneven + crossed + self._folded(order))

    def _folded(self, order: NDArray[np.int64]) -> float:
        """How much nearer the ends of two bones of the spine are than the longer bone."""
        spine = [int(order[joint]) for joint in _SPINE]
        total = 0.0
        for (start, middle), (_, end) in pairwise(pairwise(spine)):
            longer = max(self.mean[start, middle], self.mean[middle, end], 1e-6)
            total += max(0.0, float(np.log(longer / max(self.mean[start, end], 1e-6))))
        return total
