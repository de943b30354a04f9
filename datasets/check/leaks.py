"""Clips of one data set that are tested on and trained on in another: what a mix of both must not hold.

A clip leaks when the other set has the same motion, or the same recording under the same id (converted
again, its numbers may differ in the last digits). Motions are compared only where length and first frame are
equal, so that of most clips nothing is read.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from motionloom.datasets.base.records import SPLITS, Split
from motionloom.datasets.shards.clips import ClipDataset

_SAME = 1e-2
"""Metres, or radians, between two conversions of one recording at most."""

Splits = Mapping[Split, ClipDataset]


def find_leaks(sets: Mapping[str, Splits]) -> list[str]:
    """A sentence for each clip of a set, by its name, that another set has in another split."""
    found: dict[tuple[str, Split, int], str] = {}
    names = list(sets)
    for at, name in enumerate(names):
        for other in names[at + 1 :]:
            for split in SPLITS:
                for other_split in SPLITS:
                    if split != other_split and split in sets[name] and other_split in sets[other]:
                        _compare(name, sets[name][split], other, sets[other][other_split], found)
    return list(found.values())


def _compare(
    name: str, clips: ClipDataset, other: str, others: ClipDataset, found: dict[tuple[str, Split, int], str]
) -> None:
    ids = clips.ids
    other_ids = others.ids
    lengths = np.intersect1d(clips.frames, others.frames)
    here: defaultdict[tuple[int, bytes], list[int]] = defaultdict(list)
    by_id: dict[tuple[int, str], int] = {}
    for i in np.flatnonzero(np.isin(clips.frames, lengths)).tolist():
        frames = int(clips.frames[i])
        here[frames, clips.motion(i)[0].tobytes()].append(i)
        by_id[frames, ids[i]] = i
    for j in np.flatnonzero(np.isin(others.frames, lengths)).tolist():
        frames = int(others.frames[j])
        motion = others.motion(j)
        again = by_id.get((frames, other_ids[j]))
        near = [again] if again is not None else []
        for i in [*here.get((frames, motion[0].tobytes()), ()), *near]:
            if np.allclose(clips.motion(i), motion, rtol=0, atol=_SAME):
                found.setdefault(
                    (name, clips.split, i),
                    f"'{ids[i]}' of {name} ({clips.split}) is '{other_ids[j]}' of {other} ({others.split})",
                )
