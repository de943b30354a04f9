"""Skeletons are data: joint names, parents and rest offsets in metres, read from `skeletons/*.json`.

Joint order of `smplx52` is SMPL-X's (22 body, 15 left hand, 15 right hand); `smpl22` is its first 22. Y is
up, the rest pose is a T-pose that faces +Z, left is +X.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError


@dataclass(frozen=True)
class Skeleton:
    """Names, parents and rest offsets (metres, parent to child) of N joints."""

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    rest: tuple[tuple[float, float, float], ...]

    @staticmethod
    def named(name: str) -> Skeleton:
        """A skeleton that ships with the package."""
        return _load(name)

    @cached_property
    def offsets(self) -> NDArray[np.float64]:
        return np.asarray(self.rest, dtype=np.float64)

    @cached_property
    def rest_joints(self) -> NDArray[np.float64]:
        """Rest-pose joint positions [N, 3] with the root at the origin."""
        out = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents[1:], start=1):
            out[joint] = out[parent] + self.offsets[joint]
        return out

    def bones(self, joints: NDArray[np.floating]) -> NDArray[np.float64]:
        """Bones [N, 3] of joints [N, 3], parent to child; the root's is 0."""
        out = np.zeros(joints.shape)
        out[1:] = joints[1:] - joints[list(self.parents[1:])]
        return out

    def require_joints(self, joints: NDArray[np.floating]) -> None:
        """`UserError` unless joints are [..., N, 3]."""
        if joints.ndim < 2 or joints.shape[-2:] != (len(self), 3):
            raise UserError(
                f"skeleton {self.name} needs joints [..., {len(self)}, 3], not {list(joints.shape)}"
            )

    def index(self, joint: str) -> int:
        try:
            return self.joints.index(joint)
        except ValueError:
            raise UserError(f"skeleton {self.name} has no joint '{joint}'") from None

    @cached_property
    def mirror(self) -> NDArray[np.int64]:
        """Permutation [N] that swaps left and right joints."""
        swap = {"left": "right", "right": "left"}
        names = ["_".join(swap.get(w, w) for w in j.split("_")) for j in self.joints]
        return np.array([self.joints.index(n) for n in names])

    def with_lengths_of(self, joints: NDArray[np.floating]) -> Skeleton:
        """Return the skeleton with the median bone lengths of a motion [T, N, 3] in metres."""
        parents = np.array(self.parents[1:])
        measured = np.median(np.linalg.norm(joints[:, 1:] - joints[:, parents], axis=-1), axis=0)
        own = np.linalg.norm(self.offsets[1:], axis=-1)
        scaled = self.offsets.copy()
        scaled[1:] *= (measured / np.maximum(own, 1e-9))[:, None]
        rest = tuple((float(x), float(y), float(z)) for x, y, z in scaled)
        return Skeleton(self.name, self.joints, self.parents, rest)

    def __len__(self) -> int:
        return len(self.joints)


@cache
def _load(name: str) -> Skeleton:
    folder = resources.files("motionloom.datasets.motion.skeletons")
    path = folder / f"{name}.json"
    if not path.is_file():
        known = sorted(p.name.removesuffix(".json") for p in folder.iterdir() if p.name.endswith(".json"))
        raise UserError(f"no skeleton '{name}'; known: {', '.join(known)}")
    data = json.loads(path.read_text(encoding="utf-8"))
    rest = tuple((float(x), float(y), float(z)) for x, y, z in data["offsets"])
    return Skeleton(name, tuple(data["joints"]), tuple(data["parents"]), rest)
