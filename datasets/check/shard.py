"""One shard checked by itself, in any process: its bytes, its clips and its index against each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import State, state_of
from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.records import ClipMeta, ShardInfo
from motionloom.datasets.check.clip import CheckedClip, check_clip
from motionloom.datasets.check.duplicates import signature
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.plausibility import FigureMeasure, measure
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.index import ShardIndex, SplitIndex, Written, entries_of, index_path
from motionloom.datasets.shards.tar import TarClip, scan_tar


class SoundClip(NamedTuple):
    """A clip that can be read, and what the check of the whole set needs of it."""

    key: str
    meta: ClipMeta
    motion: tuple[int, int]
    """Byte in the shard where `motion.npy` starts, and its size."""
    signature: NDArray[np.float32]
    figure: FigureMeasure
    audio_width: int | None
    oddities: list[tuple[str, str]]
    """(kind, message) of each."""


@dataclass
class ShardReport:
    """What is found in one shard."""

    states: dict[str, State]
    """Its files, by name, before they were read."""
    errors: list[tuple[str, str, str]] = field(default_factory=list)
    """(kind, where, message) of each."""
    clips: list[SoundClip] = field(default_factory=list)
    index: SplitIndex | None = None
    """Its rows; None where index and tar differ."""


def examine_shard(shard: ShardInfo, root: Path, layout: MotionLayout) -> ShardReport:
    """Read a shard of the data set in `root`, and its index; never raises for what it finds in them."""
    path = root / shard.name
    report = ShardReport({name.name: state_of(name) for name in (path, index_path(path))})

    def wrong(kind: str, message: object) -> None:
        report.errors.append((kind, shard.name, str(message).removeprefix(f"{path}: ")))

    try:
        require_intact(LocalShard(path, shard))
    except UserError as error:
        wrong("shard", error)
        if not path.exists():
            return report
    try:
        clips = scan_tar(path, most=shard.samples)
        if len(clips) != shard.samples:
            wrong("shard", f"{len(clips)} samples, the manifest says {shard.samples}")
        with open_plain(path) as file:
            held = _read_index(file, path, shard, clips, report)
            frames = 0
            for clip in clips:
                place = f"{shard.name}: '{clip.key}'"
                try:
                    checked = check_clip(file, path, clip, shard, layout)
                except (UserError, ValueError) as error:
                    report.errors.append(("clip", place, str(error).removeprefix(f"{path}: ")))
                    continue
                frames += checked.meta.frames
                report.clips.append(_sound_clip(clip, checked, layout))
                if held.get(clip.key, checked.meta.present) != checked.meta.present:
                    about = "has_hands or has_face is not what the index says"
                    report.errors.append(("index", place, about))
    except (UserError, OSError) as error:
        wrong("tar", error)
        return report
    if frames != shard.frames:
        wrong("shard", f"{frames} sound frames, the manifest says {shard.frames}")
    return report


def _read_index(
    file: BinaryIO, path: Path, shard: ShardInfo, clips: list[TarClip], report: ShardReport
) -> dict[str, int]:
    """Compare the index of a shard with its open tar; what each clip holds by it, by key."""
    place = index_path(path)
    held: dict[str, int] = {}
    try:
        stored = ShardIndex.load_json(place)
        held = {clip.key: clip.held for clip in stored.clips}
        written = [Written(clip.id, clip.held, clip.source, clip.made_from) for clip in stored.clips]
        if stored.shard == shard and stored.clips == entries_of(file, path, clips, written):
            report.index = SplitIndex.of(stored)
        else:
            report.errors.append(("index", place.name, "other contents than the tar or the manifest"))
    except (UserError, OSError, ValueError) as error:
        report.errors.append(("index", place.name, f"does not fit its tar: {error}"))
    return held


def _sound_clip(clip: TarClip, checked: CheckedClip, layout: MotionLayout) -> SoundClip:
    joints = joints_of(checked.motion, layout)
    doubts = [("doubtful motion", f"{fault.kind}: {fault.text}") for fault in checked.meta.faults or ()]
    return SoundClip(
        clip.key,
        checked.meta,
        clip.members["motion.npy"],
        signature(joints, layout.fps),
        measure(joints, layout.fps),
        checked.audio_width,
        doubts + checked.oddities,
    )
