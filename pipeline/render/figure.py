"""The flat figure: rounded shapes hung on a skeleton's joints.

The page paints it where there is no WebGL2, and all outputs show it of skeletons that have no skinned body
(`body/`).

* Every drawn point ("node") is a linear blend of joints, so a whole clip's nodes are one matrix product.
  Finger and toe tips, which the skeletons lack, are extrapolated; the trunk's flanks follow the shoulders.
* Three kinds of shape: tapered capsules (limbs), hulls of spheres (trunk, palms, feet), and one head.
* Skeletons that are not SMPL-X's get plain capsules from their parents alone, so any BVH can be drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.shapes import FINGERS

CENTRE, LEFT, RIGHT, SKIN = 0, 1, 2, 3

Blend = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Capsule:
    """A tapered limb between nodes `a` and `b` with radii in metres; `fine` (fingers) skips shading."""

    a: int
    b: int
    ra: float
    rb: float
    side: int
    fine: bool = False


@dataclass(frozen=True)
class Hull:
    """The convex hull of spheres around `nodes`, radii in metres."""

    nodes: tuple[int, ...]
    radii: tuple[float, ...]
    side: int


@dataclass(frozen=True)
class Head:
    """Nodes that place the head: neck to head points up, right shoulder to left shoulder points left."""

    neck: int
    head: int
    left: int
    right: int


@dataclass(frozen=True)
class Figure:
    """Drawing recipe of one skeleton of `num_joints` joints."""

    num_joints: int
    blends: tuple[Blend, ...]
    capsules: tuple[Capsule, ...]
    hulls: tuple[Hull, ...] = ()
    head: Head | None = None
    stature: float = 0.0
    """Sum of all bone lengths the radii were chosen for, metres; 0 where radii need no scaling."""
    parents: tuple[int, ...] = field(default=())

    def scale(self, joints: NDArray[Any]) -> float:
        """Factor on all radii by the first pose of joints [T, N, 3]: small people get thin limbs."""
        if self.stature <= 0:
            return 1.0
        return float(
            np.clip(_bone_sum(np.asarray(joints[0], np.float64), self.parents) / self.stature, 0.3, 3.0)
        )

    def to_json(self) -> dict[str, Any]:
        """Compact form for the viewer's script."""
        return {
            "blends": [[[j, round(w, 4)] for j, w in blend] for blend in self.blends],
            "capsules": [[c.a, c.b, c.ra, c.rb, c.side, int(c.fine)] for c in self.capsules],
            "hulls": [[h.side, list(h.nodes), list(h.radii)] for h in self.hulls],
            "head": None if self.head is None else vars(self.head),
        }


def figure_for(parents: Sequence[int], joints: NDArray[Any]) -> Figure:
    """The figure of a skeleton with `parents` [N]; `joints` [T, N, 3] only sizes unknown skeletons."""
    key = tuple(int(p) for p in parents)
    for name in ("smplx52", "smpl22"):
        if key == Skeleton.named(name).parents:
            return human_figure(name)
    return _plain_figure(key, np.asarray(joints[0], np.float64))


@cache
def human_figure(name: str) -> Figure:
    """Trunk, limbs, head and, where the skeleton has them, hands of `smplx52` or `smpl22`."""
    skeleton = Skeleton.named(name)
    at = skeleton.index
    blends: list[Blend] = [((j, 1.0),) for j in range(len(skeleton))]
    capsules: list[Capsule] = []
    hulls: list[Hull] = []

    def node(**weights: float) -> int:
        blends.append(tuple((at(joint), weight) for joint, weight in weights.items()))
        return len(blends) - 1

    def limb(a: int, b: int, ra: float, rb: float, side: int, fine: bool = False) -> None:
        capsules.append(Capsule(a, b, ra, rb, side, fine))

    def across(joint: str, amount: float) -> int:
        return node(**{joint: 1.0, "left_shoulder": amount, "right_shoulder": -amount})

    chest, belly = [], []
    for side, sign in (("left", 1), ("right", -1)):
        chest += [
            (node(**{f"{side}_shoulder": 0.8, "spine3": 0.2}), 0.056),
            (node(**{f"{side}_collar": 0.6, "neck": 0.4}), 0.05),
            (across("spine2", sign * 0.17), 0.075),
        ]
        belly += [
            (across("spine2", sign * 0.15), 0.073),
            (across("spine1", sign * 0.13), 0.078),
            (node(**{f"{side}_hip": 0.85, "pelvis": 0.15}), 0.084),
        ]
    for spheres in (belly, chest):
        hulls.append(Hull(tuple(n for n, _ in spheres), tuple(r for _, r in spheres), CENTRE))
    limb(at("neck"), at("head"), 0.05, 0.045, SKIN)

    for side, code in (("left", LEFT), ("right", RIGHT)):
        limb(at(f"{side}_hip"), at(f"{side}_knee"), 0.083, 0.055, code)
        limb(at(f"{side}_knee"), at(f"{side}_ankle"), 0.056, 0.036, code)
        toe = node(**{f"{side}_foot": 1.42, f"{side}_ankle": -0.42})
        # Half a heel's height below the ankle along the shin, then back from the ball of the foot.
        heel = node(**{f"{side}_ankle": 1.28, f"{side}_knee": -0.08, f"{side}_foot": -0.2})
        hulls.append(
            Hull((at(f"{side}_ankle"), heel, at(f"{side}_foot"), toe), (0.036, 0.036, 0.035, 0.024), code)
        )
        limb(at(f"{side}_shoulder"), at(f"{side}_elbow"), 0.054, 0.04, code)
        limb(at(f"{side}_elbow"), at(f"{side}_wrist"), 0.041, 0.028, code)
        wrist = at(f"{side}_wrist")
        if f"{side}_index1" not in skeleton.joints:
            end = node(**{f"{side}_wrist": 1.55, f"{side}_elbow": -0.55})
            limb(wrist, end, 0.032, 0.03, code)
            continue
        knuckles = [at(f"{side}_{finger}1") for finger in FINGERS]
        hulls.append(Hull((wrist, *knuckles), (0.026, 0.015, 0.015, 0.014, 0.015, 0.014), code))
        for finger in FINGERS:
            first, second, third = (at(f"{side}_{finger}{k}") for k in (1, 2, 3))
            tip = node(**{f"{side}_{finger}3": 1.95, f"{side}_{finger}2": -0.95})
            thick = 0.0125 if finger == "thumb" else 0.0105
            limb(first, second, thick, thick * 0.95, code, True)
            limb(second, third, thick * 0.95, thick * 0.88, code, True)
            limb(third, tip, thick * 0.88, thick * 0.75, code, True)

    head = Head(at("neck"), at("head"), at("left_shoulder"), at("right_shoulder"))
    stature = _bone_sum(skeleton.rest_joints, skeleton.parents)
    return Figure(
        len(skeleton), tuple(blends), tuple(capsules), tuple(hulls), head, stature, skeleton.parents
    )


def _plain_figure(parents: tuple[int, ...], pose: NDArray[np.float64]) -> Figure:
    """Capsules from the parents alone; the side of a bone is the side of its child in the first pose."""
    capsules = []
    for child, parent in enumerate(parents):
        if parent < 0:
            continue
        length = float(np.linalg.norm(pose[child] - pose[parent]))
        radius = min(max(0.13 * length, 0.007), 0.05)
        offset = pose[child, 0] - pose[0, 0]
        side = CENTRE if abs(offset) < 0.03 else LEFT if offset > 0 else RIGHT
        capsules.append(Capsule(parent, child, radius, radius * 0.8, side, radius < 0.015))
    return Figure(len(parents), tuple(((j, 1.0),) for j in range(len(parents))), tuple(capsules))


def _bone_sum(pose: NDArray[np.float64], parents: Sequence[int]) -> float:
    bones = pose[1:] - pose[np.asarray(parents[1:], dtype=np.int64)]
    return float(np.linalg.norm(bones, axis=-1).sum())
