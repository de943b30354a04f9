"""`check`: read a whole dataset as a stranger would and list everything wrong with it.

Errors: manifest or index absent or contradicting the tars, stray or missing shards, size and sha256, tar
structure, members that do not parse, NaN, values no motion can have (`clip.py`), figures that are no people
standing on a floor in more than half of the clips (`datasets/motion/plausibility.py`; in more than a fifth a
warning), empty captions, sound that cannot be read, and clips that leak from one split into another
(`duplicates.py`).

Warnings: values beyond what a person can do, clips without captions, captions that reach past their clip, the
same motion twice in one split, a licence the manifest does not know, no training split.

Clips that the manifest excludes must be readable; what else is odd about them does not count.

Shards are read by worker processes, one clip at a time; about 2 KB of every clip are kept. A set without
errors is noted in `.checked.json` beside it, with the sha256 of its manifest and how its files were on the
disk (`state_of`, which nobody can foretell for another disk): while that is so, `check_once` reads none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import track

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import State, state_of, write_json
from motionloom.datasets.base.pool import Workers
from motionloom.datasets.base.records import (
    INDEX_FILE,
    REMOVED_FILE,
    SPLITS,
    ClipMeta,
    Manifest,
    ShardInfo,
    Split,
)
from motionloom.datasets.check.columns import check_columns
from motionloom.datasets.check.duplicates import ClipTable
from motionloom.datasets.check.findings import Findings, Problem
from motionloom.datasets.check.shard import ShardReport, SoundClip, examine_shard
from motionloom.datasets.convert.common.removed import Removed
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.plausibility import FigureMeasure, PlausibilityStats
from motionloom.datasets.shards.index import SplitIndex, load_index
from motionloom.datasets.shards.reader import manifest_layout, read_manifest
from motionloom.datasets.shards.store import LocalStore

CHECKED_FILE = ".checked.json"
"""Beside the shards of a set in which nothing was wrong."""
_VERSION = 1
"""Raised when a check finds more than before."""
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

    def add(self, meta: ClipMeta, figure: FigureMeasure) -> None:
        self._all.add(figure)
        folder = meta.source.split("/", 1)[0] if "/" in meta.source else ""
        if folder in self._folders or len(self._folders) < _MOST_FOLDERS:
            self._folders.setdefault(folder, PlausibilityStats()).add(figure)

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


class _Checked(Config):
    """`.checked.json`."""

    version: int
    manifest: str
    """Its sha256."""
    states: dict[str, State]
    """Each file as it was before it was read."""


def check(root: Path) -> list[Problem]:
    """Everything wrong with the dataset in `root`; an empty list when it is sound. Warnings are left out."""
    return examine(root).errors


def check_once(root: Path, *, workers: int = 1) -> tuple[list[Problem], dict[str, State]]:
    """(errors, state of each file when it was read); a set that was sound is read again when it changes."""
    with suppress(UserError):  # no note, or no manifest
        noted = _Checked.load_json(root / CHECKED_FILE)
        is_same = (noted.version, noted.manifest) == (_VERSION, read_manifest(LocalStore(root))[1])
        if is_same and all(state_of(root / name) == state for name, state in noted.states.items()):
            return [], noted.states
    report, states = _examine(root, workers, progress=False)
    return report.errors, states


def examine(root: Path, *, workers: int = 1, progress: bool = False) -> CheckReport:
    """Errors and warnings of the dataset in `root`. Never raises for what it finds in the data."""
    return _examine(root, workers, progress=progress)[0]


def _examine(root: Path, workers: int, *, progress: bool) -> tuple[CheckReport, dict[str, State]]:
    try:
        manifest, digest = read_manifest(LocalStore(root))
        layout = manifest_layout(manifest)
    except UserError as error:
        problem = Problem(str(root), str(error).removeprefix(f"{root}: "))
        return CheckReport([problem], [], {"manifest": 1}, {}, 0, 0), {}
    findings = Findings()
    states = {name: state_of(root / name) for name in (INDEX_FILE, REMOVED_FILE)}
    _stray_files(root, manifest, findings)
    captioned = check_columns(root, manifest, findings, states)
    table = ClipTable(root, manifest.shards, layout)
    figures = Figures(layout)
    widths: dict[int, str] = {}
    removed = Removed.of(root)
    indices: dict[Split, list[SplitIndex]] = {split: [] for split in SPLITS}
    frames = 0
    reports = _in_order(manifest.shards, root, layout, workers)
    total = len(manifest.shards)
    for number, report in enumerate(track(reports, "checking shards", total, disable=not progress)):
        shard = manifest.shards[number]
        states |= report.states
        for kind, where, message in report.errors:
            findings.error(kind, where, message)
        if report.index is not None:
            indices[shard.split].append(report.index)
        for clip in report.clips:
            where = f"{shard.name}: '{clip.key}'"
            frames += clip.meta.frames
            if removed.has(clip.meta.id, clip.meta.source):
                findings.error("removed", where, f"in {REMOVED_FILE}; give data remove again")
            if clip.meta.id in manifest.excluded:
                continue
            table.add(number, clip.key, clip.motion, clip.meta, clip.signature)
            figures.add(clip.meta, clip.figure)
            for kind, message in clip.oddities:
                if kind != "no captions" or clip.key not in captioned:
                    findings.warn(kind, where, message)
            _against_manifest(where, clip, manifest, widths, findings)
    table.report(findings)
    figures.report(root, findings)
    if not any(shard.split == "train" for shard in manifest.shards):
        findings.warn("no training split", str(root), "no clips in split 'train'")
    for split in SPLITS:
        shards = [shard for shard in manifest.shards if shard.split == split]
        if shards and len(indices[split]) == len(shards):
            _check_index(root, split, shards, indices[split], findings)
    if not findings.error_kinds:
        with suppress(OSError):  # a folder that may only be read is checked in each run
            write_json(root / CHECKED_FILE, _Checked(version=_VERSION, manifest=digest, states=states).dump())
    return CheckReport(
        findings.all_errors(str(root)),
        findings.all_warnings(str(root)),
        dict(findings.error_kinds),
        dict(findings.warning_kinds),
        len(table),
        frames,
    ), states


def _in_order(
    shards: Sequence[ShardInfo], root: Path, layout: MotionLayout, workers: int
) -> Iterator[ShardReport]:
    """The shards' reports, whichever process is done first."""
    waiting: dict[int, ShardReport] = {}
    given = 0
    # A process takes seconds to start: as long as a few shards.
    with Workers(min(workers, len(shards) // 4)) as pool:
        for position, report in pool.run(partial(examine_shard, root=root, layout=layout), shards):
            waiting[position] = report
            while given in waiting:
                yield waiting.pop(given)
                given += 1


def _stray_files(root: Path, manifest: Manifest, findings: Findings) -> None:
    listed = [shard.name for shard in manifest.shards]
    for name, times in sorted(Counter(listed).items()):
        if times > 1:
            findings.error("manifest", name, "listed twice in the manifest")
    for path in sorted(root.glob("*.tar")):
        if path.name not in listed:
            findings.error("manifest", path.name, "not in the manifest; delete it or convert again")


def _against_manifest(
    where: str, clip: SoundClip, manifest: Manifest, widths: dict[int, str], findings: Findings
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


def _check_index(
    root: Path, split: Split, shards: list[ShardInfo], indices: list[SplitIndex], findings: Findings
) -> None:
    """Compare `index.npz` with the shards' own indices."""
    rebuilt = SplitIndex.join(indices)
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
