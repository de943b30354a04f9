"""The clips of a data set that look wrong, for a person to decide about: what `motionloom data clean` shows.

Motions as the conversion's judge saw them (`motion/judge.py`), and clips that are another one again, as they
are or mirrored (`duplicates.py`). Mirror images that are declared (`mirror_of`) in the split of
their original are meant.

Decisions about them lie in `cleaned.json` beside the shards, so that they last when the set is converted
again, and the manifest lists what is left out. Since the manifest's checksum is what a run knows a data set
by, stages that have read other clips run again. No shard changes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_json
from motionloom.datasets.base.lock import folder_lock
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.base.records import (
    CLEANED_FILE,
    MANIFEST_FILE,
    SPLITS,
    Decisions,
    Fault,
    Manifest,
    Split,
)
from motionloom.datasets.check.duplicates import WHOLE, likeness, near, signature
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.judge import judge
from motionloom.datasets.shards.reader import ShardDataset, load_manifest


class Place(NamedTuple):
    """The split and number of a clip in its data set."""

    split: Split
    clip: int


Splits = Mapping[Split, ShardDataset]


@dataclass(frozen=True)
class Suspect:
    """A clip and all that is wrong with it, the worst first."""

    place: Place
    id: str
    faults: tuple[Fault, ...]
    twin: Place | None = None
    """The clip that it is again."""


def open_splits(root: Path, *, every: bool = False) -> dict[Split, ShardDataset]:
    """Return the splits of a data set, training last: of two equal clips the later one is to go."""
    held = {shard.split for shard in load_manifest(root).shards}
    return {s: ShardDataset.open(root, s, every=every) for s in reversed(SPLITS) if s in held}


def find_suspects(
    splits: Splits, kept: Collection[str] = (), *, progress: bool = False
) -> dict[Place, Suspect]:
    """The suspects of a data set, the worst first; clips whose id was `kept` before are none."""
    places: list[Place] = []
    signatures: list[NDArray[np.float32]] = []
    faults: dict[Place, list[Fault]] = {}
    with Meter("looking at clips", sum(map(len, splits.values())), shown=progress) as meter:
        for split, dataset in splits.items():
            for clip in range(len(dataset)):
                joints = floored_joints(dataset, clip)
                fps = dataset.layout.fps
                places.append(Place(split, clip))
                signatures.append(signature(joints, fps))
                stored = dataset.meta(clip).faults
                found = list(judge(joints, fps) if stored is None else stored)
                if found:
                    faults[places[-1]] = found
                meter.advance()
    twins: dict[Place, Place] = {}
    for first, second, shift in near(signatures):
        one = places[first]
        other = places[second]
        again = None if other in twins else _again(splits, one, other, shift)
        if again is not None:
            twins[other] = one
            faults.setdefault(other, []).append(again)
    return ranked(
        Suspect(place, splits[place.split].ids[place.clip], tuple(found), twins.get(place))
        for place, found in faults.items()
        if splits[place.split].ids[place.clip] not in kept
    )


def ranked(suspects: Iterable[Suspect]) -> dict[Place, Suspect]:
    """Suspects by their places, the worst first, and each one's faults likewise."""
    found = [(sorted(each.faults, key=lambda fault: -fault.weight), each) for each in suspects]
    found.sort(key=lambda pair: -pair[0][0].weight)
    return {each.place: Suspect(each.place, each.id, tuple(faults), each.twin) for faults, each in found}


def floored_joints(dataset: ShardDataset, clip: int) -> NDArray[np.float64]:
    """Joints [T, N, 3] of a clip; those of raw parameters are moved from their source's axes to the floor."""
    joints = joints_of(dataset.motion(clip), dataset.layout)
    return canonicalize(joints) if dataset.layout.family == "raw" else joints


def _again(splits: Splits, one: Place, other: Place, shift: int) -> Fault | None:
    """Return the fault of a clip `other` that repeats `one`; None where it does not, or is meant to."""
    first = splits[one.split]
    second = splits[other.split]
    original = first.meta(one.clip)
    copy = second.meta(other.clip)
    declared = (original.mirror_of or original.id) == (copy.mirror_of or copy.id)
    if declared and one.split == other.split:
        return None
    joints = floored_joints(first, one.clip), floored_joints(second, other.clip)
    how, _, share = likeness(*joints, first.layout.fps, shift)
    if not how or (one.split == other.split and share < WHOLE):
        return None
    kind = "mirrored twin" if "mirror" in how else "duplicate"
    where = f" of split {one.split}" if one.split != other.split else ""
    text = f"{how} '{original.id}'{where}"
    return Fault(kind=kind, text=text, weight=2.0 + (one.split != other.split))


def decide(root: Path, given: Decisions, where: str) -> Manifest:
    """Add the decisions of the file `where` to a data set and return its manifest."""
    with folder_lock(root):
        manifest = load_manifest(root)
        decided = Decisions.of(root).then(given)
        ids = {split: set(dataset.ids) for split, dataset in open_splits(root, every=True).items()}
        unknown = sorted({*given.left_out, *given.kept}.difference(*ids.values()))
        if unknown:
            raise UserError(f"{where}: no clip '{unknown[0]}' in {root}; it is about another data set")
        for split, own in ids.items():
            if own <= decided.left_out.keys():
                raise UserError(f"{where}: leaves out every clip of split '{split}' of {root}; keep some")
        write_json(root / CLEANED_FILE, decided.dump())
        return _written(root, manifest, decided.left_out)


def undo(root: Path) -> Manifest:
    """Forget all decisions about a data set and return its manifest."""
    with folder_lock(root):
        manifest = load_manifest(root)
        (root / CLEANED_FILE).unlink(missing_ok=True)
        return _written(root, manifest, {})


def _written(root: Path, manifest: Manifest, excluded: dict[str, str]) -> Manifest:
    manifest = manifest.model_copy(update={"excluded": excluded})
    write_json(root / MANIFEST_FILE, manifest.dump())
    return manifest
