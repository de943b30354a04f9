"""`check`: read a whole dataset as a stranger would and list everything wrong with it.

Errors: manifest or index absent or contradicting the tars, stray or missing shards, size and sha256, tar
structure, members that do not parse, NaN, values no motion can have (`clip.py`), figures that are no people
standing on a floor in more than half of the clips (`datasets/motion/plausibility.py`; in more than a fifth a
warning), empty captions, sound that cannot be read, and clips that leak from one split into another
(`duplicates.py`).

Warnings: values beyond what a person can do, clips without captions, captions that reach past their clip, the
same motion twice in one split, a licence the manifest does not know, no training split.

Clips that the manifest excludes must be readable; what else is odd about them does not count.

One shard's directory and one clip are in memory at a time, and about 600 bytes for every clip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import open_plain
from motionloom.datasets.base.records import (
    INDEX_FILE,
    REMOVED_FILE,
    SPLITS,
    ClipMeta,
    Manifest,
    ShardInfo,
    Split,
)
from motionloom.datasets.check.clip import CheckedClip, check_clip
from motionloom.datasets.check.duplicates import ClipTable
from motionloom.datasets.check.findings import Findings, Problem
from motionloom.datasets.convert.common.removed import Removed
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.plausibility import PlausibilityStats, measure
from motionloom.datasets.shards.checksums import LocalShard, require_intact
from motionloom.datasets.shards.index import (
    ShardIndex,
    SplitIndex,
    Written,
    clip_entries,
    index_path,
    load_index,
)
from motionloom.datasets.shards.reader import load_manifest, manifest_layout
from motionloom.datasets.shards.tar import TarClip, scan_tar

_MOST_FOLDERS = 64
"""Folders of the source that are judged by themselves."""
_LEAST_CLIPS = 10
"""Clips in such a folder."""


class Figures:
    """Collects the clips of a set."""

    def __init__(self, layout: MotionLayout) -> None:
        self._layout = layout
        self._all = PlausibilityStats()
        self._folders = dict[str, PlausibilityStats]()
        # Parameters may stay on the floor of their source.
        self._on_zero = layout.family != "raw"

    def add(self, meta: ClipMeta, joints: NDArray[np.floating]) -> None:
        clip = measure(joints, self._layout.fps)
        self._all.add(clip)
        folder = meta.source.split("/", 1)[0] if "/" in meta.source else ""
        if folder in self._folders or len(self._folders) < _MOST_FOLDERS:
            self._folders.setdefault(folder, PlausibilityStats()).add(clip)

    def report(self, root: Path, findings: Findings) -> None:
        oddities = self._all.oddities(floor_at_zero=self._on_zero)
        for oddity in oddities:
            if oddity.is_error:
                findings.error("no people standing on a floor", str(root), oddity.text)
            else:
                findings.warn("odd figures", str(root), oddity.text)
        known = {oddity.kind for oddity in oddities}
        for folder, stats in sorted(self._folders.items()):
            if len(self._folders) == 1 or len(stats) < _LEAST_CLIPS:
                continue
            for oddity in stats.oddities(floor_at_zero=self._on_zero):
                if oddity.is_error and oddity.kind not in known:
                    findings.warn("odd figures", str(root), f"source '{folder or '.'}': {oddity.text}")


@dataclass(frozen=True)
class CheckReport:
    """The outcome for a whole dataset. All findings are counted, at most a thousand of one kind listed."""

    errors: list[Problem]
    warnings: list[Problem]
    error_kinds: dict[str, int]
    warning_kinds: dict[str, int]
    clips: int
    """Sound clips."""
    frames: int


def check(root: Path) -> list[Problem]:
    """Everything wrong with the dataset in `root`; an empty list when it is sound. Warnings are left out."""
    return examine(root).errors


def examine(root: Path, *, progress: bool = False) -> CheckReport:
    """Errors and warnings of the dataset in `root`. Never raises for what it finds in the data."""
    try:
        manifest = load_manifest(root)
        layout = manifest_layout(manifest)
    except UserError as error:
        problem = Problem(str(root), str(error).removeprefix(f"{root}: "))
        return CheckReport([problem], [], {"manifest": 1}, {}, 0, 0)
    findings = Findings()
    frames = 0
    _stray_files(root, manifest, findings)
    table = ClipTable(root, manifest.shards, layout)
    figures = Figures(layout)
    widths: dict[int, str] = {}
    removed = Removed.of(root)
    for number, shard in enumerate(track(manifest.shards, "checking shards", disable=not progress)):
        indexed = _indexed_present(root / shard.name)
        try:
            for row, place, clip in _checked_clips(root / shard.name, shard, layout, findings):
                where = f"{shard.name}: '{place.key}'"
                if row < len(indexed) and indexed[row] != clip.meta.present:
                    findings.error("index", where, "has_hands or has_face is not what the index says")
                frames += clip.meta.frames
                if removed.has(clip.meta.id, clip.meta.source):
                    findings.error("removed", where, f"in {REMOVED_FILE}; give data remove again")
                if clip.meta.id in manifest.excluded:
                    continue
                joints = joints_of(clip.motion, layout)
                table.add(number, place, clip.meta, joints)
                figures.add(clip.meta, joints)
                for fault in clip.meta.faults or ():
                    findings.warn("doubtful motion", where, f"{fault.kind}: {fault.text}")
                for kind, message in clip.oddities:
                    findings.warn(kind, where, message)
                _against_manifest(where, clip, manifest, widths, findings)
        except (UserError, OSError) as error:
            findings.error("tar", shard.name, str(error).removeprefix(f"{root / shard.name}: "))
    table.report(findings)
    figures.report(root, findings)
    if not any(shard.split == "train" for shard in manifest.shards):
        findings.warn("no training split", str(root), "no clips in split 'train'")
    for split in SPLITS:
        shards = [shard for shard in manifest.shards if shard.split == split]
        if shards:
            _check_index(root, split, shards, findings)
    return CheckReport(
        findings.all_errors(str(root)),
        findings.all_warnings(str(root)),
        dict(findings.error_kinds),
        dict(findings.warning_kinds),
        len(table),
        frames,
    )


def _stray_files(root: Path, manifest: Manifest, findings: Findings) -> None:
    listed = [shard.name for shard in manifest.shards]
    for name in sorted({name for name in listed if listed.count(name) > 1}):
        findings.error("manifest", name, "listed twice in the manifest")
    for path in sorted(root.glob("*.tar")):
        if path.name not in listed:
            findings.error("manifest", path.name, "not in the manifest; delete it or convert again")


def _checked_clips(
    path: Path, shard: ShardInfo, layout: MotionLayout, findings: Findings
) -> Iterator[tuple[int, TarClip, CheckedClip]]:
    """(row, place, clip) of every sound clip of one shard; what is wrong on the way goes to `findings`."""
    try:
        require_intact(LocalShard(path, shard))
    except UserError as error:
        findings.error("shard", shard.name, str(error).removeprefix(f"{path}: "))
        if not path.exists():
            return
    clips = scan_tar(path, most=shard.samples)
    if len(clips) != shard.samples:
        findings.error("shard", shard.name, f"{len(clips)} samples, the manifest says {shard.samples}")
    frames = 0
    with open_plain(path) as file:
        for row, clip in enumerate(clips):
            try:
                checked = check_clip(file, path, clip, shard, layout)
            except (UserError, ValueError) as error:
                message = str(error).removeprefix(f"{path}: ")
                findings.error("clip", f"{shard.name}: '{clip.key}'", message)
                continue
            frames += checked.meta.frames
            yield row, clip, checked
    if frames != shard.frames:
        findings.error("shard", shard.name, f"{frames} sound frames, the manifest says {shard.frames}")


def _against_manifest(
    where: str, clip: CheckedClip, manifest: Manifest, widths: dict[int, str], findings: Findings
) -> None:
    licence = clip.meta.licence
    if licence not in {manifest.licence, *manifest.licences}:
        findings.warn("licence", where, f"licence '{licence}' is not in the manifest")
    if clip.audio_width is not None:
        widths.setdefault(clip.audio_width, where)
        first = next(iter(widths))
        if clip.audio_width != first:
            other = f"audio.npy has {clip.audio_width} columns, that of {widths[first]} has {first}"
            findings.error("audio", where, other)


def _indexed_present(path: Path) -> list[int]:
    """Return what a shard's index states of its clips; an unreadable index is reported with the indices."""
    try:
        return [clip.held for clip in ShardIndex.load_json(index_path(path)).clips]
    except (UserError, OSError):
        return []


def _check_index(root: Path, split: Split, shards: list[ShardInfo], findings: Findings) -> None:
    before = findings.error_kinds["index"]
    # A generator: the JSON indices of a large split would not fit into memory together.
    rebuilt = SplitIndex.build(_sound_indices(root, shards, findings))
    if findings.error_kinds["index"] > before:
        return
    try:
        flat = load_index(root, split, shards)
    except UserError as error:
        findings.error("index", INDEX_FILE, str(error).removeprefix(f"{root / INDEX_FILE}: "))
        return
    if any(
        not np.array_equal(getattr(flat, field.name), getattr(rebuilt, field.name)) for field in fields(flat)
    ):
        other = f"split '{split}' says something else than the shards' own indices"
        findings.error("index", INDEX_FILE, other)


def _sound_indices(root: Path, shards: list[ShardInfo], findings: Findings) -> Iterator[ShardIndex]:
    for shard in shards:
        path = root / shard.name
        try:
            stored = ShardIndex.load_json(index_path(path))
            written = [Written(clip.id, clip.held, clip.source, clip.made_from) for clip in stored.clips]
            entries = clip_entries(path, written)
        except (UserError, OSError, ValueError) as error:
            findings.error("index", index_path(path).name, f"does not fit its tar: {error}")
            continue
        if stored.shard != shard or stored.clips != entries:
            findings.error("index", index_path(path).name, "other contents than the tar or the manifest")
            continue
        yield stored
