"""Clips that are in a set twice: by id, by motion, or as the mirror image of a clip of another split.

Signatures of each clip's seconds, in the figure's own frame, are kept while the shards are read; a mirror
image shares them, and a copy that was cut, slowed by a little or made noisy has nearly the same. Near
signatures only point out candidates: each pair is read again and compared, joint by joint, before anything is
said, with the seconds that both have in common.

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
from motionloom.datasets.motion.canonical import facing, ground, mirror, resample
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.tar import npy_from_bytes

SAME_METRES = 0.008
"""Mean distance of joints, seen from the figure, below which two seconds are of one recording."""
LEAST_SECONDS, LEAST_SHARE = 2.0, 0.8
"""What two clips have in common at least, or the share of the shorter one."""
STILL_METRES = 0.05
"""Somebody of whom no joint moves so far in a second says nothing."""
REACH_METRES = 0.025
"""Deviation of near signatures, a value."""
MOMENTS, NEIGHBOURS, _AXES = 5, 16, 12
"""Moments of a second, seconds that each is compared with, and axes in which that is done."""
WHOLE = 0.9
"""Share of the shorter clip from which it is the same motion again."""
_RATE, _WINDOW, _HOP, _AROUND, _FINE, _SHIFTS = 20, 20, 2, 8, 4, 2
"""Samples a second, of a window, and from one window to the next; samples around that are tried, parts of
one, and shifts of a pair.
"""

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
        self.root = root
        self.shards = shards
        self.layout = layout
        self._clips: list[_Seen] = []
        self._signatures: list[NDArray[np.float32]] = []

    def __len__(self) -> int:
        return len(self._clips)

    def add(
        self, shard: int, key: str, motion: tuple[int, int], meta: ClipMeta, signed: NDArray[np.float32]
    ) -> None:
        """Remember a clip of shard number `shard` with its `signature`; `motion` as in `_Seen`."""
        self._clips.append(_Seen(meta.id, meta.mirror_of or meta.id, shard, key, motion))
        self._signatures.append(signed)

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
            split = self._split(clip)
            there = self._split(first)
            if clip.id != original and split != there:
                message = f"mirrors '{original}', {of} in split '{there}', not '{split}'"
                findings.error("mirror image in another split", self._where(clip), message)

    def _same_motions(self, findings: Findings) -> None:
        told: set[tuple[int, bool]] = set()
        for earlier, later, shift in near(self._signatures):
            one = self._clips[earlier]
            two = self._clips[later]
            split = self._split(two)
            other = self._split(one)
            apart = split != other
            # A family in two splits has been reported already.
            if one.id == two.id or (later, apart) in told or (apart and one.family == two.family):
                continue
            layout = self.layout
            first, second = (joints_of(self._motion(clip), layout) for clip in (one, two))
            how, _, share = likeness(first, second, layout.fps, shift)
            # Overlapping stretches of one recording are usual within a split.
            if not how or (not apart and (share < WHOLE or "mirror" in how or one.family == two.family)):
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


def signature(joints: NDArray[np.floating], fps: float) -> NDArray[np.float32]:
    """Return what each second of a clip of joints [T, N, 3] shares with its copies and mirror images and no
    other: heights, and places ahead of the pelvis, of the further and the nearer of pairs of joints, in the
    figure's own frame at some moments [n, S]; the seconds begin every tenth of one.
    """
    body = _sampled(joints, fps)
    if len(body) < _WINDOW:
        body = np.concatenate([body, np.repeat(body[-1:], _WINDOW - len(body), axis=0)])
    turned = ground(body - body[:, :1]) * np.exp(-1j * facing(body))[:, None]
    measured = [
        np.sort(values[:, _PAIRS], axis=-1).reshape(len(body), -1) for values in (body[..., 1], turned.real)
    ]
    rows = np.concatenate([body[:, :1, 1], *measured], axis=1)
    starts = np.arange(0, len(body) - _WINDOW + 1, _RATE // 10)
    moments = starts[:, None] + np.arange(0, _WINDOW, _WINDOW // MOMENTS)[None, :MOMENTS]
    return np.asarray(rows[moments].reshape(len(starts), -1), dtype=np.float32)


def _sampled(joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """The 22 joints of the body `_RATE` times a second."""
    return resample(np.asarray(joints[:, :BODY_JOINTS], dtype=np.float64), fps, float(_RATE))


def near(signatures: list[NDArray[np.float32]]) -> Iterator[tuple[int, int, int]]:
    """Pairs (earlier, later) of clips of which several seconds, as far apart in both, hardly differ; and the
    tenths of a second by which those of the later one begin later; a pair comes with its likeliest shifts.
    """
    from scipy.spatial import KDTree

    if not signatures:
        return
    counts = [len(one) for one in signatures]
    owner = np.repeat(np.arange(len(counts)), counts)
    place = np.concatenate([np.arange(count) for count in counts])
    points = np.concatenate(signatures)
    # Still seconds are alike in everybody; a second is told by its changes.
    moving = np.flatnonzero(
        np.ptp(points.reshape(len(points), MOMENTS, -1), axis=1).max(axis=1) > STILL_METRES
    )
    if not len(moving):
        return
    few = points[moving] - points[moving].mean(axis=0)
    axes = np.linalg.eigh(few[:: max(1, len(few) // 20_000)].T @ few[:: max(1, len(few) // 20_000)])[1]
    few = few @ axes[:, -_AXES:]
    # Every third second of each clip is looked up among all of them.
    asked = np.flatnonzero(place[moving] % 3 == 0)
    most = min(NEIGHBOURS, len(few))
    reach = REACH_METRES * np.sqrt(points.shape[1])
    _, found = KDTree(few).query(few[asked], k=most, distance_upper_bound=reach)
    rows, columns = np.nonzero(found.reshape(len(asked), -1) < len(few))
    one = moving[asked[rows]]
    other = moving[found.reshape(len(asked), -1)[rows, columns]]
    apart = owner[one] != owner[other]
    first = np.minimum(one, other)[apart]
    second = np.maximum(one, other)[apart]
    pairs, votes = np.unique(
        np.stack([owner[first], owner[second], (place[second] - place[first]) // 4], axis=1),
        axis=0,
        return_counts=True,
    )
    shifts: dict[tuple[int, int], list[tuple[float, int]]] = {}
    for (earlier, later, shift), count in zip(pairs.tolist(), votes.tolist(), strict=True):
        shorter = min(counts[earlier], counts[later])
        if count >= min(2, shorter // 6 + 1):
            both = signatures[earlier], signatures[later]
            # A few votes say little: all seconds of both are compared, as far apart as those that voted.
            best = max((_nearness(*both, at), at) for at in range(4 * shift, 4 * shift + 4))
            if 6 * best[0] >= min(10 * LEAST_SECONDS - 9, LEAST_SHARE * shorter):
                shifts.setdefault((earlier, later), []).append(best)
    for (earlier, later), several in sorted(shifts.items(), key=lambda pair: pair[0][::-1]):
        # Of steps, others than the same ones may be nearer, as their moments are not the same.
        for _, shift in sorted(several)[: -1 - _SHIFTS : -1]:
            yield earlier, later, shift


def _nearness(first: NDArray[np.float32], second: NDArray[np.float32], shift: int) -> float:
    """How many rows of the second signature hardly differ from the one `shift` rows before in the first; one
    that differs a little counts less.
    """
    start = max(shift, 0)
    end = max(start, min(len(second), len(first) + shift))
    gap = second[start:end] - first[start - shift : end - shift]
    apart = np.einsum("ij,ij->i", gap, gap) / (REACH_METRES**2 * gap.shape[1])
    return float(np.maximum(1 - apart, 0).sum())


class Likeness(NamedTuple):
    """How a motion repeats another."""

    how: str
    """The beginning of a phrase; empty if it does not."""
    seconds: float = 0.0
    share: float = 0.0
    """Of the shorter of both."""


def likeness(first: NDArray[np.float64], second: NDArray[np.float64], fps: float, shift: int) -> Likeness:
    """Return how joints `second` [T, N, 3], whose seconds begin `shift` tenths of one later, repeat those
    `first`, each second seen from itself.
    """
    one = _sampled(first, fps)
    other = _sampled(second, fps)
    best = Likeness("")
    for how, figure in (("the same recording as", one), ("the mirror image of", mirror(one, _NAMED))):
        seconds = _repeated(figure, other, shift)
        share = seconds * _RATE / min(len(one), len(other))
        if seconds > best.seconds and (seconds >= LEAST_SECONDS or share > LEAST_SHARE):
            best = Likeness(how if share > LEAST_SHARE else f"{seconds:.1f} s of {how}", seconds, share)
    return best


def _repeated(first: NDArray[np.float64], second: NDArray[np.float64], shift: int) -> float:
    """Seconds of the second joints that are in the first, `shift` tenths of a second before or nearly so."""
    from scipy.interpolate import CubicSpline

    window = min(_WINDOW, len(first), len(second))
    # A cut or another speed moves the moments at which the frames of a source are sampled.
    moments = np.arange(_FINE * (len(first) - 1) + 1) / _FINE
    here = _windows(CubicSpline(np.arange(len(first)), first)(moments), window, 1, _FINE)
    there = _windows(second, window, _HOP)
    apart = np.full(len(there), np.inf)
    best = _FINE * _HOP * (np.arange(len(there)) - shift)
    for tried in (_FINE * np.arange(-_AROUND, _AROUND + 1), np.arange(1 - _FINE, _FINE)):
        middle = best.copy()
        for near_by in tried:
            at = middle + near_by
            both = np.flatnonzero((at >= 0) & (at < len(here)))
            far = np.linalg.norm(here[at[both]] - there[both], axis=-1).mean(axis=(1, 2))
            nearer = both[far < apart[both]]
            apart[both] = np.minimum(apart[both], far)
            best[nearer] = at[nearer]
    same = apart < SAME_METRES
    moves = np.ptp(there, axis=1).max(axis=(1, 2)) > STILL_METRES
    count = int(same.sum())
    return (count + window // _HOP - 1) * _HOP / _RATE if (same & moves).any() else 0.0


def _windows(joints: NDArray[np.float64], window: int, hop: int, step: int = 1) -> NDArray[np.float64]:
    """Windows [n, W, N, 3] of every `step`-th sample that begin every `hop` samples, seen from each
    pelvis in the direction of the middle.
    """
    starts = np.arange(0, len(joints) - step * (window - 1), hop)
    taken = joints[starts[:, None] + step * np.arange(window)]
    middle = taken[:, window // 2]
    plane = (ground(taken) - ground(taken)[:, :, :1]) * np.exp(-1j * facing(middle[:, None]))[..., None]
    return np.stack([plane.imag, taken[..., 1], plane.real], axis=-1)
