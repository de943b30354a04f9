"""BVH folders and archives -> shards: any skeleton, through a joint map (`datasets/motion/joint_map.py`).

Three steps, each independent of the number of workers:
1. plan (`bvh_plan.py`): read every file once; list it with its captions, split, frame count and digest;
2. features: one task a batch (an archive, or 64 loose files) parses, maps, resamples and encodes its clips
   into a file under `OUT/.features`, so an archive is unpacked once although its clips go to many shards;
3. shards: `write_dataset` copies slices of those files; the folder is removed when the manifest stands.
A killed run resumes at the first unfinished batch or shard.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from motionloom.datasets.convert.archives import Batch
from motionloom.datasets.convert.base import ConversionPlan, run_pool
from motionloom.datasets.convert.bvh_plan import SUFFIX, BvhClip, BvhConfig, plan_bvh
from motionloom.datasets.convert.conversion import digest, drop
from motionloom.datasets.convert.feature_store import BatchIndex, StoredClip, store_batch, stored_batch
from motionloom.datasets.motion.bvh import read_bvh
from motionloom.datasets.motion.canonical import canonicalize, resample, retarget
from motionloom.datasets.motion.features import encode
from motionloom.datasets.motion.joint_map import JointMap
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.schema import ClipMeta, Dropped, Manifest, Split, UserError
from motionloom.datasets.shards.writer import write_dataset

__all__ = ["BvhConfig", "convert_bvh", "plan_bvh"]

CONVERTER = "bvh"
CONVERTER_VERSION = 1
FEATURES_FOLDER = ".features"
FIGURE_METRES = (0.5, 4.0)
"""A person's largest extent over a clip lies between these; anything else is a wrong unit."""


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

    `strict` stops when a clip is missing or cannot be read, or an archive is damaged. Same input and options
    give the same bytes for any `workers`.
    """
    layout = config.motion_layout()
    JointMap.load(
        config.joint_map, target=layout.skeleton_name
    )  # a wrong map should fail before the long part
    plan = plan_bvh(config, workers=workers, progress=progress)
    if strict:
        plan.require_whole()
    options = config.options() | {"source_sha256": digest([clip.sha256 for _, clip in plan.items])}
    folder = out / FEATURES_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    items, failed = _make_features(config, plan, folder, options, workers, progress)
    if failed and strict:
        raise UserError(
            f"{failed[0].source}: {failed[0].reason} (strict: {len(failed)} clips cannot be read)"
        )
    if not items:
        reasons = "; ".join(f"{d.source}: {d.reason}" for d in [*failed, *plan.left_out()][:3])
        raise UserError(f"{config.source}: no clip can be converted ({reasons or 'none was found'})")
    manifest = write_dataset(
        out,
        items,
        StoredClip.sample,
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
        describe=StoredClip.source,
        dropped=[*plan.left_out(), *failed],
        notes=plan.notes,
    )
    shutil.rmtree(folder)
    return manifest


@dataclass(frozen=True)
class FeatureTask:
    """One batch to convert."""

    config: BvhConfig
    batch: Batch
    clips: tuple[BvhClip, ...]
    path: Path
    fingerprint: str


def _make_features(
    config: BvhConfig,
    plan: ConversionPlan[BvhClip],
    folder: Path,
    options: dict[str, Any],
    workers: int,
    progress: bool,
) -> tuple[list[tuple[Split, StoredClip]], list[Dropped]]:
    """Convert batch by batch into `folder`; the clips to write, in plan order, and those that failed."""
    layout = config.motion_layout()
    groups: dict[int, list[BvhClip]] = {}
    for _, clip in plan.items:
        groups.setdefault(clip.number, []).append(clip)
    tasks = []
    for number, clips in sorted(groups.items()):
        fingerprint = digest([CONVERTER_VERSION, options, [[clip.label, clip.sha256] for clip in clips]])
        tasks.append(
            FeatureTask(config, clips[0].batch, tuple(clips), folder / f"{number:06d}.bin", fingerprint)
        )
    indices: dict[int, BatchIndex] = {}
    with Progress(disable=not progress) as bar:
        shown = bar.add_task("converting clips", total=len(plan.items))
        for position, index in run_pool(make_batch, tasks, workers):
            indices[position] = index
            bar.advance(shown, len(tasks[position].clips))
    split_of = {clip.label: split for split, clip in plan.items}
    items: list[tuple[Split, StoredClip]] = []
    failed: list[Dropped] = []
    for position, task in enumerate(tasks):
        failed += indices[position].dropped
        for clip in task.clips:
            if clip.label not in indices[position].clips:
                continue
            first, frames = indices[position].clips[clip.label]
            split = split_of[clip.label]
            meta = ClipMeta(
                id=clip.id,
                source=clip.label,
                split=split,
                layout=layout.name,
                family=layout.family,
                fps=layout.fps,
                skeleton=layout.skeleton_name,
                frames=frames,
                licence=config.licence,
                has_hands=layout.num_joints > BODY_JOINTS,
                has_face=False,
            )
            items.append((split, StoredClip(task.path, first, meta, clip.texts, layout.dim)))
    return items, failed


def make_batch(task: FeatureTask) -> BatchIndex:
    """Convert one batch, or find it done."""
    found = stored_batch(task.path, task.fingerprint)
    if found is not None:
        return found
    dim = task.config.motion_layout().dim
    return store_batch(task.path, _batch_features(task), dim=dim, fingerprint=task.fingerprint)


def _batch_features(task: FeatureTask) -> Iterator[tuple[str, NDArray[np.float32] | Dropped]]:
    layout = task.config.motion_layout()
    joint_map = JointMap.load(task.config.joint_map, target=layout.skeleton_name)
    waiting = {clip.path: clip for clip in task.clips}
    try:
        for file in task.batch.read(SUFFIX):
            clip = waiting.pop(file.path, None)  # a second member of the same name finds nothing
            if clip is None:
                continue
            try:
                yield clip.label, _clip_features(task.config, layout, joint_map, clip, file.data)
            except MemoryError:
                raise
            except Exception as error:  # whatever a bad file makes of the libraries below
                yield clip.label, drop(clip.label, error)
            if not waiting:
                return
    except UserError as error:
        for clip in waiting.values():
            yield clip.label, drop(clip.label, error)


def _clip_features(
    config: BvhConfig, layout: MotionLayout, joint_map: JointMap, clip: BvhClip, data: bytes
) -> NDArray[np.float32]:
    """Features [T', D] of one file."""
    joints = joint_map.apply(read_bvh(data, name=clip.label), unit=config.unit, up=config.up)
    extent = float(np.ptp(joints, axis=1).max())
    if not FIGURE_METRES[0] < extent < FIGURE_METRES[1]:
        raise UserError(
            f"{clip.label}: the figure measures {extent:.3g} m with unit '{config.unit}'; set the file's unit"
        )
    joints = resample(joints, config.source_fps or clip.fps, config.fps)
    if config.retarget:
        joints = retarget(joints, layout.skeleton)
    return encode(canonicalize(joints), layout)
