"""BVH conversion, first step: options, and a plan of what becomes of every file of the source."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from pydantic import Field
from rich.progress import Progress

from motionloom.datasets.convert.archives import Batch, list_batches
from motionloom.datasets.convert.base import ConversionPlan
from motionloom.datasets.convert.captions import CaptionTable, read_captions
from motionloom.datasets.convert.conversion import digest, drop
from motionloom.datasets.convert.splits import check_id, hash_split, read_split_files
from motionloom.datasets.motion.bvh import read_header
from motionloom.datasets.motion.joint_map import Unit, Up
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption, Config, Dropped, Split, UserError
from motionloom.datasets.shards.files import sha256_of
from motionloom.datasets.shards.index import SPLITS

SUFFIX = ".bvh"


class BvhConfig(Config):
    """Options of the BVH converter."""

    source: Path
    """A folder of .bvh files and/or tar archives of them, or one such file."""
    joint_map: Path
    captions: Path | None = None
    """`captions.jsonl`; without it clips have no captions."""
    splits: Path | None = None
    """Folder of train.txt, val.txt, test.txt; else the captions' `split`, else 80/5/15 by hash of the id."""
    name: str = "bvh"
    licence: str
    layout: str = "body133"
    fps: float = Field(default=20.0, gt=0, le=240)
    source_fps: float | None = Field(default=None, gt=0)
    """Overrides the files' frame time, for collections that state a wrong one."""
    unit: Unit = "cm"
    up: Up = "y"
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton."""
    min_seconds: float = Field(default=1.0, ge=0)
    max_seconds: float | None = Field(default=None, gt=0)
    uncaptioned: Literal["drop", "keep"] = "drop"
    """What to do with clips that a captions file does not list."""
    limit: int | None = Field(default=None, ge=1)
    """Convert only this many clips, chosen by a hash of the id so that they stay spread over the source."""

    def motion_layout(self) -> MotionLayout:
        """The layout of the written shards."""
        layout = MotionLayout.named(self.layout, fps=self.fps)
        if layout.family == "raw" or layout.has("face"):
            raise UserError(f"layout {self.layout} cannot be made from joints; use body133 or h3d263")
        return layout

    def options(self) -> dict[str, Any]:
        """What the output depends on, for the manifest: files by name and digest instead of local paths."""
        given = self.dump()
        given.pop("source")
        for key in ("joint_map", "captions"):
            path: Path | None = getattr(self, key)
            given[key] = {"file": path.name, "sha256": sha256_of(path)} if path else None
        given["splits"] = bool(self.splits)
        return given


@dataclass(frozen=True)
class SourceClip:
    """A motion file as the scan finds it."""

    batch: Batch
    number: int
    label: str
    path: str
    sha256: str
    frames: int
    fps: float
    problem: str
    """Why the file cannot be read; empty when it can."""


@dataclass(frozen=True)
class BvhClip(SourceClip):
    """A clip of the plan."""

    id: str
    texts: tuple[Caption, ...]


def plan_bvh(config: BvhConfig, *, workers: int = 1, progress: bool = False) -> ConversionPlan[BvhClip]:
    """Find every clip and decide what becomes of it, without converting anything."""
    batches, ignored = list_batches(config.source, SUFFIX)
    found: list[SourceClip] = []
    broken: list[Dropped] = []
    with Progress(disable=not progress) as bar, ThreadPoolExecutor(max(workers, 1)) as pool:
        shown = bar.add_task("reading the source", total=len(batches))
        # Threads are enough: unpacking and hashing run outside the interpreter's lock.
        for clips, problems in pool.map(_scan, range(len(batches)), batches):
            found += clips
            broken += problems
            bar.advance(shown)
    return _decide(config, found, broken, ignored)


def _scan(number: int, batch: Batch) -> tuple[list[SourceClip], list[Dropped]]:
    """Headers of one batch, and what is wrong with the batch as a whole."""
    clips: list[SourceClip] = []
    try:
        for file in batch.read(SUFFIX):
            frames, fps, problem = 0, 0.0, file.error
            try:
                if not problem:
                    header = read_header(file.data, name=file.label)
                    frames, fps = header.frames, header.fps
            except UserError as error:
                problem = str(error)
            sha256 = hashlib.sha256(file.data).hexdigest()
            clips.append(SourceClip(batch, number, file.label, file.path, sha256, frames, fps, problem))
    except UserError as error:
        return clips, [drop(batch.label, error)]
    return clips, []


def _decide(
    config: BvhConfig, found: list[SourceClip], broken: list[Dropped], ignored: int
) -> ConversionPlan[BvhClip]:
    """Which of the files found become samples, in which split."""
    table = read_captions(config.captions) if config.captions else CaptionTable({}, {})
    listed, notes = read_split_files(config.splits) if config.splits else ({}, [])
    items: list[tuple[Split, BvhClip]] = []
    dropped: list[Dropped] = []
    uncaptioned: list[str] = []
    ids: dict[str, str] = {}
    contents: dict[str, str] = {}
    unreadable: set[str] = set()
    other_rate = 0
    # Captioned files first, so that a stray copy never takes the place of the clip that has captions.
    for clip in sorted(found, key=lambda clip: table.find(clip.path) is None):
        row = table.find(clip.path)
        try:
            clip_id = row.id if row else check_id(str(PurePosixPath(clip.path).with_suffix("")), clip.label)
        except UserError as error:
            broken.append(drop(clip.label, error))
            continue
        if clip.problem:
            unreadable.add(clip_id)
            broken.append(drop(clip.label, UserError(clip.problem)))
            continue
        texts = row.texts(source="captions") if row else ()
        if config.captions and not texts:
            uncaptioned.append(clip.label)
        other_rate += bool(row and row.fps and abs(row.fps - clip.fps) > 0.01 * clip.fps)
        if clip_id in ids:
            reason = f"second file for clip id '{clip_id}'; the first is {ids[clip_id]}"
        elif clip.sha256 in contents:
            reason = f"same bytes as {contents[clip.sha256]}"
        elif config.captions and not texts and config.uncaptioned == "drop":
            reason = "no captions"
        elif config.splits and clip_id not in listed:
            reason = "in no split file"
        else:
            reason = _length_problem(config, clip)
        ids.setdefault(clip_id, clip.label)
        contents.setdefault(clip.sha256, clip.label)
        if reason:
            dropped.append(Dropped(source=clip.label, reason=reason))
            continue
        split = listed.get(clip_id) or (row.split if row else None) or hash_split(clip_id)
        items.append((split, BvhClip(**vars(clip), id=clip_id, texts=texts)))
    if other_rate:
        notes.append(f"{other_rate} captions state another frame rate than their file; the file's counts")
    if config.limit is not None and len(items) > config.limit:
        notes.append(f"limited to {config.limit} of {len(items)} clips")
        items = _limited(items, config.limit)
    frames: dict[Split, int] = dict.fromkeys(SPLITS, 0)
    for split, planned in items:
        frames[split] += _frames_out(config, planned)
    wanted = {clip_id: row.file or clip_id for clip_id, row in table.rows.items()}
    wanted |= {clip_id: clip_id for clip_id in listed if clip_id not in wanted}
    return ConversionPlan(
        name=f"{config.source.name} -> {config.name}",
        items=items,
        frames=frames,
        found=len(found),
        missing=[
            Dropped(source=name, reason=f"clip '{clip_id}' is listed, but its file is not in the source")
            for clip_id, name in wanted.items()
            if clip_id not in ids and clip_id not in unreadable
        ],
        uncaptioned=uncaptioned,
        dropped=dropped,
        broken=broken,
        ignored=ignored,
        notes=notes,
    )


def _length_problem(config: BvhConfig, clip: SourceClip) -> str:
    seconds = clip.frames / (config.source_fps or clip.fps)
    if seconds < config.min_seconds:
        return f"{seconds:.2f} s, shorter than {config.min_seconds:g} s"
    if config.max_seconds is not None and seconds > config.max_seconds:
        return f"{seconds:.2f} s, longer than {config.max_seconds:g} s"
    return ""


def _limited(items: list[tuple[Split, BvhClip]], limit: int) -> list[tuple[Split, BvhClip]]:
    """A subset chosen by a hash of the id, in the old order."""
    kept = set(sorted((clip.id for _, clip in items), key=digest)[:limit])
    return [item for item in items if item[1].id in kept]


def _frames_out(config: BvhConfig, clip: BvhClip) -> int:
    """Frames of a clip's features: `resample`'s count, less one for h3d velocities."""
    count = int((clip.frames - 1) * config.fps / (config.source_fps or clip.fps) + 1e-6) + 1
    return count - (config.motion_layout().family == "h3d")
