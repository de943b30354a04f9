"""Faults of motion that a metric should notice: each a change of joints [T, N, 3], metres, Y up **[ours]**.

`swapped` is none of a single motion: every one is right, and another's. What a metric makes of these is in
docs/evaluation.md, by `benchmarks/perturbation.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.skeleton import Skeleton

Joints = NDArray[np.float64]
Fault = Callable[[Joints, float, np.random.Generator], Joints]
"""Of joints, frames a second and random numbers."""


def noise(metres: float) -> Fault:
    """Every joint of every frame elsewhere, by a normal deviate."""
    return lambda joints, fps, rng: joints + rng.normal(0.0, metres, joints.shape)


def frozen(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
    """The first frame for the whole time."""
    return np.repeat(joints[:1], len(joints), axis=0)


def late(seconds: float) -> Fault:
    """The motion begins later and ends where time is up; until then it stands in its first frame."""

    def change(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
        wait = min(len(joints) - 1, round(seconds * fps))
        return np.concatenate([np.repeat(joints[:1], wait, axis=0), joints[: len(joints) - wait]])

    return change


def backwards(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
    """From the last frame to the first."""
    return joints[::-1].copy()


def mirrored(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
    """Left and right exchanged."""
    name = {22: "smpl22", 52: "smplx52"}[joints.shape[1]]
    return np.asarray(mirror(joints, Skeleton.named(name)))


def gliding(metres_a_second: float) -> Fault:
    """The whole figure glides forward over the floor beside what it does."""

    def change(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
        out = joints.copy()
        out[..., 2] += (np.arange(len(joints)) * metres_a_second / fps)[:, None]
        return out

    return change


def raised(metres: float) -> Fault:
    """Above the floor, or below it where negative."""

    def change(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
        out = joints.copy()
        out[..., 1] += metres
        return out

    return change


FAULTS: Mapping[str, Fault] = {
    "noise of 1 cm": noise(0.01),
    "noise of 5 cm": noise(0.05),
    "frozen": frozen,
    "0.3 s late": late(0.3),
    "backwards": backwards,
    "mirrored": mirrored,
    "gliding 0.6 m/s": gliding(0.6),
    "5 cm above the floor": raised(0.05),
    "3 cm in the floor": raised(-0.03),
}
"""By name, as tables have it."""


def swapped(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Whose motion each of `count` clips has: nobody its own, [n]."""
    order = rng.permutation(count)
    out = np.empty(count, dtype=np.int64)
    out[order] = np.roll(order, 1)
    return out
