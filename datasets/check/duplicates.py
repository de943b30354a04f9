"""Clips that are in a set twice: by id, by motion, or as the mirror image of a clip of another split.

A signature of each clip is kept while the shards are read: heights at eight moments, which a mirror image
shares. Near signatures only point out candidates: each pair is read again and compared, joint by joint,
before anything is said.

What counts:
- the same id twice, or the same recording in two splits, mirrored or not: an error (the test split would be
  trained on);
- the same motion under two ids of one split: a warning (it weighs double);
- a clip whose `mirror_of` names a clip, or has a sister, in another split: an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.records import ClipMeta, ShardInfo
from motionloom.datasets.check.findings import Findings
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.tar import TarClip, npy_from_bytes

SAME_METRES = 0.005
"""Mean distance of joints below which two motions are the same recording."""
MOMENTS = 8
"""Frames of a clip, evenly spread, that its signature is of."""
NEIGHBOURS = 4
"""Clips of near signatures that each is compared with."""

_NAMED = Skeleton.named("smpl22")
_PAIRS = [
    [_NAMED.index(f"{side}_{joint}") for side in ("left", "right")]
    for joint in ("wrist", "elbow", "knee", "ankle")
]


class _Seen(NamedTuple):
    """A clip that was read, and where it lies."""

    id: str
    family: str
    """Id of the clip that it mirrors, else its own."""
    shard: int
    key: str
    motion: tuple[int, int]
    """Byte in the shard where `motion.npy` starts, and its size: a shard's directory takes long to read."""


class ClipTable:
    """Every clip seen, in reading order."""

    def __init__(self, root: Path, shards: list[ShardInfo], layout: MotionLayout) -> None:
        self.root, self.shards, self.layout = root, shards, layout
        self._clips: list[_Seen] = []
        self._signatures: list[NDArray[np.float32]] = []

    def __len__(self) -> int:
        return len(self._clips)

    def add(self, shard: int, clip: TarClip, meta: ClipMeta, joints: NDArray[np.floating]) -> None:
        """Remember a clip of shard number `shard`, with joints [T, N, 3]."""
        motion = clip.members["motion.npy"]
        self._clips.append(_Seen(meta.id, meta.mirror_of or meta.id, shard, clip.key, motion))
        self._signatures.append(signature(joints))

    def report(self, findings: Findings) -> None:
        first: dict[str, _Seen] = {}
        families: dict[str, list[_Seen]] = {}
        for clip in self._clips:
            before = first.setdefault(clip.id, clip)
            families.setdefault(clip.family, []).append(clip)
            if before is not clip:
                split = self._split(before)
                kind = "also" if split == self._split(clip) else f"of split '{split}' also"
                message = f"id '{clip.id}' is {kind} {self._where(before)}"
                findings.error("repeated id", self._where(clip), message)
        for family, clips in families.items():
            self._family_apart(family, clips, findings)
        self._same_motions(findings)

    def _family_apart(self, original: str, clips: list[_Seen], findings: Findings) -> None:
        """An original and its mirror images, or the mirror images alone, in two splits."""
        first = next((clip for clip in clips if clip.id == original), clips[0])
        of = "which is" if first.id == original else f"as '{first.id}' does"
        for clip in clips:
            split, there = self._split(clip), self._split(first)
            if clip.id != original and split != there:
                message = f"mirrors '{original}', {of} in split '{there}', not '{split}'"
                findings.error("mirror image in another split", self._where(clip), message)

    def _same_motions(self, findings: Findings) -> None:
        told: set[tuple[int, bool]] = set()
        for earlier, later in near(self._signatures):
            one, two = self._clips[earlier], self._clips[later]
            split, other = self._split(two), self._split(one)
            apart = split != other
            # A family in two splits has been reported already.
            if one.id == two.id or (later, apart) in told or (apart and one.family == two.family):
                continue
            first, second = self._motion(one), self._motion(two)
            if apart:
                how = likeness(
                    joints_of(first, self.layout), joints_of(second, self.layout), self.layout.skeleton
                )
            else:
                how = "the same motion as" if np.array_equal(first, second) else ""
            if not how:
                continue
            told.add((later, apart))
            message = f"'{two.id}' is {how} '{one.id}' ({self._where(one)})"
            if apart:
                leak = f"{message}, which is in split '{other}', not '{split}'"
                findings.error("same recording in two splits", self._where(two), leak)
            else:
                findings.warn("same motion", self._where(two), message)

    def _split(self, clip: _Seen) -> str:
        return self.shards[clip.shard].split

    def _where(self, clip: _Seen) -> str:
        return f"{self.shards[clip.shard].name}: '{clip.key}'"

    def _motion(self, clip: _Seen) -> NDArray[np.floating]:
        path = self.root / self.shards[clip.shard].name
        with open_plain(path) as file:
            start, size = clip.motion
            file.seek(start)
            return npy_from_bytes(file.read(size), f"{path}: '{clip.key}.motion.npy'")


def signature(joints: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return what a clip of joints [T, N, 3] shares with its mirror image and no other: its length in frames,
    and heights of the pelvis and of the higher and the lower of pairs of joints at some moments [S].
    """
    heights = joints[np.linspace(0, len(joints) - 1, MOMENTS).round().astype(int), :, 1]
    pairs = np.sort(heights[:, _PAIRS], axis=-1)
    return np.concatenate([[len(joints)], heights[:, 0], pairs.ravel()]).astype(np.float32)


def near(signatures: list[NDArray[np.float32]]) -> Iterator[tuple[int, int]]:
    """Pairs (earlier, later) of signatures [S] that hardly differ, by the later."""
    from scipy.spatial import KDTree

    if not signatures:
        return
    points = np.array(signatures)
    reach = SAME_METRES * np.sqrt(points.shape[1])
    most = min(NEIGHBOURS + 1, len(points))
    _, neighbours = KDTree(points).query(points, k=most, distance_upper_bound=reach)
    for later, others in enumerate(neighbours.reshape(len(points), -1).tolist()):
        yield from ((other, later) for other in sorted(others) if other < later)


def likeness(first: NDArray[np.float64], second: NDArray[np.float64], skeleton: Skeleton) -> str:
    """Return how joints `second` [T, N, 3] repeat those `first`, as the beginning of a phrase, or ""."""
    if _distance(first, second) < SAME_METRES:
        return "the same recording as"
    return "the mirror image of" if _distance(mirror(first, skeleton), second) < SAME_METRES else ""


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(a - b, axis=-1).mean())
