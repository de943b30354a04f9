"""Clips that are in a set twice: by id, by motion, or as the mirror image of a clip of another split.

40 bytes a clip are kept while the shards are read (four 64-bit hashes and where the clip lies), so a million
clips fit easily. A hash only points out candidates: each is read again and compared before anything is said.

What counts:
- the same id twice, or the same motion in two splits: an error (the test split would be trained on);
- the same motion under two ids of one split: a warning (it weighs double);
- a clip whose `mirror_of` names a clip, or has a sister, in another split: an error;
- a motion that is the mirror image of one in another split without saying so: an error. Candidates have the
  same root heights, which mirroring leaves alone; layouts without a root height are not searched for these.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.check.clip import read_meta, read_motion
from motionloom.datasets.check.findings import LISTED, Findings
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import ClipMeta, ShardInfo
from motionloom.datasets.shards.tar import TarClip, scan_tar

SAME_METRES = 0.005
"""Mean distance of joints below which two motions are the same recording."""

_PARTNERS = 4
"""Earlier clips that a mirror candidate is compared with."""

_LEAST_HEIGHTS = 8
"""Different root heights a clip needs before equal ones can mean the same recording."""


class ClipTable:
    """Hashes of every clip seen, in reading order."""

    def __init__(self, root: Path, shards: list[ShardInfo], layout: MotionLayout) -> None:
        self.root, self.shards, self.layout = root, shards, layout
        self._ids, self._families = array("Q"), array("Q")
        self._motions, self._heights = array("Q"), array("Q")
        self._shard, self._row = array("I"), array("I")
        self._scan = lru_cache(maxsize=8)(lambda shard: scan_tar(root / shards[shard].name))

    def __len__(self) -> int:
        return len(self._ids)

    def add(self, shard: int, row: int, meta: ClipMeta, motion: NDArray[np.floating]) -> None:
        """Remember clip number `row` of shard number `shard`."""
        self._ids.append(_hash(meta.id.encode()))
        self._families.append(_hash((meta.mirror_of or meta.id).encode()))
        self._motions.append(_hash(np.ascontiguousarray(motion).tobytes()))
        self._heights.append(self._height_hash(motion))
        self._shard.append(shard)
        self._row.append(row)

    def report(self, findings: Findings) -> None:
        self._same_ids(findings)
        self._families_apart(findings)
        self._same_motions(findings)
        self._hidden_mirrors(findings)

    def _same_ids(self, findings: Findings) -> None:
        for rows in _runs(self._ids):
            first = self._meta(rows[0])
            for row in rows[1:]:
                if findings.error_kinds["repeated id"] > LISTED:
                    return
                if (meta := self._meta(row)).id != first.id:
                    continue  # two ids with one hash
                split, other = self._split(row), self._split(rows[0])
                kind = "also" if split == other else f"of split '{other}' also"
                message = f"id '{meta.id}' is {kind} {self._where(rows[0])}"
                findings.error("repeated id", self._where(row), message)

    def _families_apart(self, findings: Findings) -> None:
        """An original and its mirror images, or the mirror images alone, in two splits."""
        for rows in _runs(self._families):
            if len({self._split(row) for row in rows}) < 2:
                continue
            metas = {row: self._meta(row) for row in rows}
            first = min(rows, key=lambda row: (metas[row].mirror_of is not None, row))
            original = metas[first].mirror_of or metas[first].id
            for row in rows:
                meta, there = metas[row], self._split(first)
                if row == first or meta.mirror_of != original or self._split(row) == there:
                    continue
                of = "which is" if metas[first].mirror_of is None else f"as '{metas[first].id}' does"
                findings.error(
                    "mirror image in another split",
                    self._where(row),
                    f"mirrors '{original}', {of} in split '{there}', not '{self._split(row)}'",
                )
            if findings.error_kinds["mirror image in another split"] > LISTED:
                return

    def _same_motions(self, findings: Findings) -> None:
        for rows in _runs(self._motions):
            for at, row in enumerate(rows[1:], start=1):
                counts = (
                    findings.error_kinds["same motion in two splits"],
                    findings.warning_kinds["same motion"],
                )
                if max(counts) > LISTED:
                    return
                apart = [other for other in rows[:at] if self._split(other) != self._split(row)]
                other = apart[0] if apart else rows[0]
                one, two = self._meta(row), self._meta(other)
                if one.id == two.id or not np.array_equal(self._motion(row), self._motion(other)):
                    continue
                message = f"'{one.id}' has the same motion as '{two.id}' ({self._where(other)})"
                if apart:
                    leak = f"{message}, which is in split '{self._split(other)}', not '{self._split(row)}'"
                    findings.error("same motion in two splits", self._where(row), leak)
                else:
                    findings.warn("same motion", self._where(row), message)

    def _hidden_mirrors(self, findings: Findings) -> None:
        for rows in _runs(self._heights):
            if self._heights[rows[0]] == 0 or len({self._split(row) for row in rows}) < 2:
                continue
            for at, row in enumerate(rows[1:], start=1):
                for other in [r for r in rows[:at] if self._unexplained(r, row)][:_PARTNERS]:
                    how = self._likeness(other, row)
                    if how:
                        findings.error(
                            "same recording in two splits",
                            self._where(row),
                            f"'{self._meta(row).id}' is {how} '{self._meta(other).id}' "
                            f"({self._where(other)}), which is in split '{self._split(other)}', "
                            f"not '{self._split(row)}'",
                        )
                        break
                if findings.error_kinds["same recording in two splits"] > LISTED:
                    return

    def _unexplained(self, a: int, b: int) -> bool:
        """Two clips of different splits that no other rule has put together."""
        return (
            self._split(a) != self._split(b)
            and self._families[a] != self._families[b]
            and self._motions[a] != self._motions[b]
        )

    def _likeness(self, a: int, b: int) -> str:
        first, second = self._motion(a), self._motion(b)
        if first.shape != second.shape:
            return ""
        one, other = (joints_of(motion, self.layout) for motion in (first, second))
        return likeness(one, other, self.layout.skeleton)

    def _height_hash(self, motion: NDArray[np.floating]) -> int:
        """0 when the heights could belong to any clip."""
        if not self.layout.has("root_height"):
            return 0
        heights = np.ascontiguousarray(motion[:, self.layout.slice("root_height")])
        return _hash(heights.tobytes()) if len(np.unique(heights)) >= _LEAST_HEIGHTS else 0

    def _split(self, row: int) -> str:
        return self.shards[self._shard[row]].split

    def _clip(self, row: int) -> tuple[Path, TarClip]:
        shard = self._shard[row]
        return self.root / self.shards[shard].name, self._scan(shard)[self._row[row]]

    def _where(self, row: int) -> str:
        path, clip = self._clip(row)
        return f"{path.name}: '{clip.key}'"

    def _meta(self, row: int) -> ClipMeta:
        path, clip = self._clip(row)
        with path.open("rb") as file:
            return read_meta(file, path, clip)

    def _motion(self, row: int) -> NDArray[np.floating]:
        path, clip = self._clip(row)
        with path.open("rb") as file:
            return read_motion(file, path, clip)


def likeness(first: NDArray[np.float64], second: NDArray[np.float64], skeleton: Skeleton) -> str:
    """Return how joints `second` [T, N, 3] repeat those `first`, as the beginning of a phrase, or ""."""
    if _distance(first, second) < SAME_METRES:
        return "the same recording as"
    return "the mirror image of" if _distance(mirror(first, skeleton), second) < SAME_METRES else ""


def _runs(values: array[int]) -> Iterator[list[int]]:
    """Positions of every value that occurs more than once, in reading order."""
    hashes = np.array(values, dtype=np.uint64)
    order = np.argsort(hashes, kind="stable")
    starts = np.flatnonzero(np.diff(hashes[order], prepend=np.uint64(0)) != 0)
    starts = np.union1d(starts, [0]) if len(hashes) else starts
    lengths = np.diff(starts, append=len(hashes))
    several = lengths > 1
    groups = [order[at : at + n] for at, n in zip(starts[several], lengths[several], strict=True)]
    for rows in sorted(groups, key=lambda group: int(group[0])):
        yield [int(row) for row in rows]


def _hash(data: bytes) -> int:
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "little")


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(a - b, axis=-1).mean())
