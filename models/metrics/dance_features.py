"""Kinetic and geometric features of a dance, the embeddings behind FID_k and FID_m (UDE section 4.3).

They are those of fairmotion as AI Choreographer and Bailando use them. Choices that their numbers hang on:

- Energy expenditure divides only the *previous* position by the frame time (a misplaced bracket), so that it
  depends on where the motion is; it is kept.
- Frame times are constants: 1/60 s for kinetic features and 1/120 s for the speeds of geometric ones,
  whatever the data. Resample motions of other rates to 60 fps to compare with published values.
- Bailando moves the first root to the origin, AI Choreographer does not: `zero_start` does it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KINETIC_SECONDS = 1 / 60
MANUAL_SECONDS = 1 / 120
WINDOW = 2
"""Frames to either side that kinetic features are averaged over."""

# Lengths of the body the thresholds are given in: upper arm, shoulders, hips of the mean SMPL body, metres.
_ARM = float(np.linalg.norm(np.subtract((0.199113488, 0.236807942, -0.0180702247),
                                        (0.454445392, 0.221158922, -0.0410167128))))  # fmt: skip
_SHOULDERS = float(np.linalg.norm(np.subtract((0.199113488, 0.236807942, -0.0180702247),
                                              (-0.191692337, 0.236928746, -0.0123055102))))  # fmt: skip
_HIPS = float(np.linalg.norm(np.subtract((0.0564076714, -0.323069185, 0.0109197125),
                                         (-0.0624834076, -0.331302464, 0.0150412619))))  # fmt: skip

_NAMES = (
    *("root", "lhip", "rhip", "belly", "lknee", "rknee", "spine", "lankle", "rankle"),
    *("chest", "ltoes", "rtoes", "neck", "linshoulder", "rinshoulder", "head"),
    *("lshoulder", "rshoulder", "lelbow", "relbow", "lwrist", "rwrist"),
)
"""The joints in the order of `smpl22`, by the names that the statements use."""


def zero_start(joints: NDArray[np.floating]) -> Array:
    """Joints [T, N, 3] with the first root at the origin."""
    x = np.asarray(joints, dtype=np.float64)
    return x - x[:1, :1]


def kinetic_features(joints: NDArray[np.floating]) -> Array:
    """Joints [T >= 3, N, 3], Y up -> [3 N]: horizontal and vertical energy, energy spent, joint by joint."""
    x = np.asarray(joints, dtype=np.float64)
    steps = np.diff(x, axis=0)
    velocity = _windowed(steps, 1, len(x)) / KINETIC_SECONDS
    horizontal = (velocity[..., [0, 2]] ** 2).sum(-1).mean(0)
    vertical = (velocity[..., 1] ** 2).mean(0)
    after = steps[1:] / KINETIC_SECONDS
    before = x[1:-1] - x[:-2] / KINETIC_SECONDS
    change = _windowed((after - before) / KINETIC_SECONDS, 1, len(x))
    spent = np.linalg.norm(change, axis=-1).mean(0)
    return np.stack([horizontal, vertical, spent], axis=-1).reshape(-1)


def _windowed(values: Array, first: int, frames: int) -> Array:
    """Means over frames t - 2 .. t + 2, t = 1 .. frames - 1; `values` begin with frame `first`."""
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    centre = np.arange(1, frames)
    begin = np.clip(centre - WINDOW - first, 0, len(values))
    end = np.clip(centre + WINDOW + 1 - first, 0, len(values))
    count = np.maximum(end - begin, 1).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((sums[end] - sums[begin]) / count)


def manual_features(joints: NDArray[np.floating]) -> Array:
    """Joints [T >= 2, N >= 22, 3], Y up -> [32]: how often each of 32 geometric statements is true."""
    return np.asarray(_Poses(np.asarray(joints, dtype=np.float64)).statements().mean(1))


class _Poses:
    """Frames 1 .. T - 1 of a motion, with the frame before each."""

    def __init__(self, joints: Array) -> None:
        self.now = dict(zip(_NAMES, np.moveaxis(joints[1:, : len(_NAMES)], 1, 0), strict=True))
        self.before = dict(zip(_NAMES, np.moveaxis(joints[:-1, : len(_NAMES)], 1, 0), strict=True))
        floor = np.zeros((len(joints) - 1, 3))
        floor[:, 1] = joints[1:, :, 1].min(1)
        self.now["floor"] = floor

    def statements(self) -> Array:
        """The statements [32, T - 1], 1 where true."""
        up = np.array([0.0, 1.0, 0.0])
        rows = [
            # The hands: forward of the body, above the neck, moving upwards, elbows bent.
            self.moves_off("neck", "rhip", "lhip", "rwrist", 1.8 * _ARM),
            self.moves_off("neck", "lhip", "rhip", "lwrist", 1.8 * _ARM),
            self.beyond(self.bone("chest", "neck"), "neck", "rwrist", 0.2 * _ARM),
            self.beyond(self.bone("chest", "neck"), "neck", "lwrist", 0.2 * _ARM),
            # The published code reads the velocity of the chest here, not of the wrists: twice the same.
            self.moves_along("belly", "chest", "chest", 1.8 * _ARM),
            self.moves_along("belly", "chest", "chest", 1.8 * _ARM),
            self.angle(self.bone("relbow", "rshoulder"), self.bone("relbow", "rwrist"), 0, 110),
            self.angle(self.bone("lelbow", "lshoulder"), self.bone("lelbow", "lwrist"), 0, 110),
            # Hands apart, approaching each other or the root, and fast.
            self.beyond(self.bone("lshoulder", "rshoulder"), "lwrist", "rwrist", 2.5 * _SHOULDERS),
            self.moves_along("lwrist", "rwrist", "rwrist", 1.4 * _ARM),
            self.moves_along("rwrist", "root", "lwrist", 1.4 * _ARM),
            self.moves_along("lwrist", "root", "rwrist", 1.4 * _ARM),
            self.fast("rwrist", 2.5 * _ARM),
            self.fast("lwrist", 2.5 * _ARM),
            # The feet: before the body, raised, apart, knees bent, fast.
            self.off_plane("root", "lhip", "ltoes", "rankle", 0.38 * _ARM),
            self.off_plane("root", "rhip", "rtoes", "lankle", 0.38 * _ARM),
            self.beyond(up, "floor", "rankle", 1.2 * _ARM),
            self.beyond(up, "floor", "lankle", 1.2 * _ARM),
            self.beyond(self.bone("lhip", "rhip"), "lankle", "rankle", 2.1 * _HIPS),
            self.angle(self.bone("rknee", "rhip"), self.bone("rknee", "rankle"), 0, 110),
            self.angle(self.bone("lknee", "lhip"), self.bone("lknee", "lankle"), 0, 110),
            self.fast("rankle", 2.5 * _ARM),
            self.fast("lankle", 2.5 * _ARM),
            # Limbs away from the trunk, the trunk itself, hands low, the whole body fast.
            self.angle(self.bone("neck", "root"), self.bone("rshoulder", "relbow"), 25, 180),
            self.angle(self.bone("neck", "root"), self.bone("lshoulder", "lelbow"), 25, 180),
            self.angle(self.bone("neck", "root"), self.bone("rhip", "rknee"), 50, 180),
            self.angle(self.bone("neck", "root"), self.bone("lhip", "lknee"), 50, 180),
            self.off_plane("rankle", "neck", "lankle", "root", 0.5 * _ARM),
            self.angle(self.bone("neck", "root"), up, 70, 110),
            self.beyond(-up, "floor", "rwrist", -1.2 * _ARM),
            self.beyond(-up, "floor", "lwrist", -1.2 * _ARM),
            self.fast("root", 2.3 * _ARM),
        ]
        return np.stack(rows).astype(np.float64)

    def bone(self, a: str, b: str) -> Array:
        """From joint a to joint b, [T - 1, 3]."""
        return np.asarray(self.now[b] - self.now[a])

    def beyond(self, normal: Array, a: str, p: str, limit: float) -> NDArray[np.bool_]:
        """p is further than `limit` from the plane through a with this normal."""
        return np.asarray(_along(self.bone(a, p), normal) > limit)

    def off_plane(self, a: str, b: str, c: str, p: str, limit: float) -> NDArray[np.bool_]:
        """p is further than `limit` from the plane through a, b and c."""
        normal = np.cross(self.bone(a, c), self.bone(a, b))
        return np.asarray(_along(self.bone(a, p), normal) > limit)

    def angle(self, u: Array, v: Array, low: float, high: float) -> NDArray[np.bool_]:
        """The angle between u and v lies between `low` and `high` degrees."""
        cosine = _along(u, v) / np.maximum(np.linalg.norm(u, axis=-1), 1e-300)
        degrees = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return np.asarray((degrees > low) & (degrees < high))

    def moves_along(self, a: str, b: str, p: str, limit: float) -> NDArray[np.bool_]:
        """p moves, as seen from a, faster than `limit` a second towards b."""
        return np.asarray(_along(self._seen(a, p), self.bone(a, b)) / MANUAL_SECONDS > limit)

    def moves_off(self, a: str, b: str, c: str, p: str, limit: float) -> NDArray[np.bool_]:
        """p moves, as seen from a, faster than `limit` a second away from the plane through a, b and c."""
        normal = np.cross(self.bone(a, c), self.bone(a, b))
        return np.asarray(_along(self._seen(a, p), normal) / MANUAL_SECONDS > limit)

    def fast(self, p: str, limit: float) -> NDArray[np.bool_]:
        """p moves faster than `limit` a second."""
        return np.asarray(np.linalg.norm(self.now[p] - self.before[p], axis=-1) / MANUAL_SECONDS > limit)

    def _seen(self, a: str, p: str) -> Array:
        """Displacement of p since the frame before, as seen from a."""
        return np.asarray((self.now[p] - self.now[a]) - (self.before[p] - self.before[a]))


def _along(v: Array, axis: Array) -> Array:
    """Length of v [..., 3] along an axis of any length; 0 along one without length."""
    length = np.linalg.norm(axis, axis=-1)
    return np.asarray((v * axis).sum(-1) / np.where(length > 0, length, np.inf))
