"""BVH folders and archives -> shards: any skeleton, through a joint map (`datasets/motion/joint_map.py`).

Three steps, each independent of the number of workers:
1. plan: read every motion file once, list it with its captions, split, frame count and digest;
2. features: one task a batch (an archive, or 64 loose files) parses, maps, resamples and encodes its clips into a
   file under `OUT/.features`, so that an archive is unpacked once although its clips end up in many shards;
3. shards: `write_dataset` copies slices of those files; the folder is removed when the manifest stands.
A killed run resumes at the first unfinished batch or shard.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from rich.progress import Progress

from motionloom.datasets.convert.archives import Batch, SourceFile, list_batches
from motionloom.datasets.convert.base import (
    SPLITS,
    ConversionPlan,
    check_id,
    hash_split,
    read_split_files,
    run_pool,
)
from motionloom.datasets.convert.captions import CaptionTable, read_captions
from motionloom.datasets.motion.bvh import read_bvh, read_header
from motionloom.datasets.motion.canonical import canonicalize, resample, retarget
from motionloom.datasets.motion.features import encode
from motionloom.datasets.motion.joint_map import JointMap, Unit, Up
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.schema import Caption, ClipMeta, Config, Dropped, Manifest, Split, UserError
from motionloom.datasets.shards.files import atomic_file, sha256_of, write_json
from motionloom.datasets.shards.index import MANIFEST_FILE
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset

CONVERTER = "bvh"
CONVERTER_VERSION = 1
SUFFIX = ".bvh"
FEATURES_FOLDER = ".features"
FIGURE_METRES = (0.5, 4.0)
"""A person's largest extent over a clip lies between these; anything else is a wrong unit."""


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
            raise UserError(f"layout {self.layout} cannot be made from joint positions; use body133 or h3d263")
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
class BvhClip:
    """One clip of the plan."""

    id: str
    batch: int
    label: str
    path: str
    sha256: str
    frames: int
    """Frames of the file, at its own rate."""
    fps: float
    texts: tuple[Caption, ...]


def plan_bvh(config: BvhConfig, *, workers: int = 1, progress: bool = False) -> ConversionPlan[BvhClip]:
    """Find every clip and decide what becomes of it, without converting anything."""
    return _plan(config, list_batches(config.source, SUFFIX), workers, progress)


def convert_bvh(
    config: BvhConfig,
    out: Path,
    *,
    workers: int = 1,
    progress: bool = True,
    strict: bool = False,
    seed: int = 0,
    clips_per_shard: int = 256,
) -> Manifest:
    """Convert the source into shards under `out`; clips left out are in the manifest with their reasons.

    `strict` stops at the first unreadable clip, missing file or damaged archive instead. Same input and options give
    the same bytes for any `workers`.
    """
    layout = config.motion_layout()
    JointMap.load(config.joint_map, target=layout.skeleton_name)
    batches, ignored = list_batches(config.source, SUFFIX)
    plan = _plan(config, (batches, ignored), workers, progress)
    bad = [*plan.missing, *(drop for drop in plan.dropped if drop.reason.startswith(_BROKEN))]
    if strict and bad:
        raise UserError(f"{bad[0].source}: {bad[0].reason} (strict: {len(bad)} such problems)")
    options = config.options() | {"source_sha256": _digest(plan)}
    folder = out / FEATURES_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    made, failed = _make_features(config, plan, batches, folder, options, workers, progress, strict)
    items = [(split, made[clip.label]) for split, clip in plan.items if clip.label in made]
    if not items:
        reasons = "; ".join(f"{drop.source}: {drop.reason}" for drop in [*failed, *plan.dropped][:3])
        raise UserError(f"{config.source}: no clip can be converted ({reasons or 'none was found'})")
    manifest = write_dataset(
        out,
        items,
        FeatureClip.sample,
        name=config.name,
        layout=layout,
        licence=config.licence,
        converter=CONVERTER,
        converter_version=CONVERTER_VERSION,
        options=options,
        workers=workers,
        clips_per_shard=clips_per_shard,
        seed=seed,
        strict=strict,
        progress=progress,
        describe=FeatureClip.label,
    )
    manifest = manifest.model_copy(
        update={"dropped": [*plan.missing, *plan.dropped, *failed, *manifest.dropped]}
    )
    write_json(out / MANIFEST_FILE, manifest.dump())
    shutil.rmtree(folder)
    return manifest
