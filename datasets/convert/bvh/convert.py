"""BVH folders and archives -> shards: any skeleton, through a joint map (`datasets/motion/joint_map.py`).

Three steps, each independent of the number of workers:
1. plan (`plan.py`): read every file once; list it with its captions, split, frame count and checksum;
2. features: one task a batch (an archive, or 64 loose files) parses, maps, resamples and encodes its clips
   into a file of the work folder, so an archive is unpacked once although its clips go to many shards;
3. shards: the clips are copied from those files.
A killed run resumes at the first unfinished batch or shard; a finished one finds its shards and makes
nothing.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.convert.bvh.maps import SUFFIX, JointMaps, guess_maps, map_name
from motionloom.datasets.convert.bvh.plan import BvhClip, BvhConfig, plan_bvh
from motionloom.datasets.convert.common.archives import Batch
from motionloom.datasets.convert.common.conversion import Conversion
from motionloom.datasets.convert.common.feature_step import FeatureStep
from motionloom.datasets.convert.common.feature_store import store_batch, stored_batch, stored_features
from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan, drop
from motionloom.datasets.motion.bvh import read_bvh
from motionloom.datasets.motion.joint_map import JointMap
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.motion.resting_hands import with_resting_hands
from motionloom.datasets.schema import Dropped, UserError
from motionloom.datasets.shards.sample import Sample

__all__ = ["BvhConfig", "plan_bvh", "prepare_bvh"]

CONVERTER = "bvh"
CONVERTER_VERSION = 2

_NAMED_JOINTS = 12
"""Joints without a row that are named; a hand alone has twenty."""


def prepare_bvh(
    config: BvhConfig,
    *,
    workers: int = 1,
    progress: bool = False,
    scan: Path | None = None,
    maps: Path | None = None,
) -> Conversion[BvhClip]:
    """Plan the conversion. `scan` is a file that remembers what unchanged files hold, `maps` a folder for the
    joint maps that are guessed.
    """
    target = config.mapped_skeleton()
    given = None
    if config.joint_map != "auto":  # a wrong map should fail before the long part
        given = JointMap.load(config.joint_map, target=target.name)
    plan = plan_bvh(config, workers=workers, progress=progress, scan=scan)
    contents = [clip.found.sha256 for _, clip in plan.items]
    options = config.options() | {"source_sha256": sha256_of_json(contents)}
    guessed: dict[str, JointMap] = {}
    if given is None:
        plan, guessed = _guessed(config, plan, maps)
        sources = {key: joint_map.sources for key, joint_map in guessed.items()}
        options["joint_map"] = {"file": "auto", "sha256": sha256_of_json(sources)}
    clips = BvhClips(config, JointMaps(given, guessed))
    made_from = sha256_of_json(options)
    groups: dict[int, list[BvhClip]] = {}
    for _, clip in plan.items:
        groups.setdefault(clip.number, []).append(clip)
    batches = [
        BvhBatch(clips, group[0].batch, number, tuple(clip.label() for clip in group), made_from)
        for number, group in sorted(groups.items())
    ]
    positions = {batch.number: position for position, batch in enumerate(batches)}
    return Conversion(
        config=config,
        plan=plan,
        convert=clips,
        licence=config.licence,
        converter=CONVERTER,
        version=CONVERTER_VERSION,
        options=options,
        features=FeatureStep(batches, lambda clip: positions[clip.number], clips.take),
        see=clips.see,
        subset_of=lambda clip: clip.subset,
        in_order=lambda clip: clip.batch.archive is not None,
    )


def _guessed(
    config: BvhConfig, plan: ConversionPlan[BvhClip], folder: Path | None
) -> tuple[ConversionPlan[BvhClip], dict[str, JointMap]]:
    """The plan, with a note on each guessed joint map, and the maps."""
    clips = ((clip.batch, clip.label(), clip.found.skeleton) for _, clip in plan.items)
    guesses = guess_maps(clips, config.mapped_skeleton(), config.source, folder)
    notes = [
        f"{map_name(number)}: guessed from {guess.source}; {guess.summary()}"
        for number, guess in enumerate(guesses.values(), start=1)
    ]
    maps = {key: guess.joint_map(f"the guess from {guess.source}") for key, guess in guesses.items()}
    return dataclasses.replace(plan, notes=[*plan.notes, *notes]), maps


@dataclass(frozen=True)
class BvhClips:
    """Turns clips into samples; holds what all clips of a conversion share."""

    config: BvhConfig
    maps: JointMaps

    @cached_property
    def layout(self) -> MotionLayout:
        """The layout of the samples."""
        return self.config.motion_layout()

    def __call__(self, clip: BvhClip) -> Sample:
        """One clip by itself. An archive is read up to the clip: for many clips, make the batch."""
        return self._sample(clip, self.features(clip.label(), self._read(clip)))

    def see(self, clip: BvhClip) -> SourceJoints:
        """The joints of one clip as the map reads them, and the joints that no row of it names."""
        motion = read_bvh(self._read(clip), name=clip.label())
        joint_map = self.maps.of(motion)
        joints = joint_map.apply(motion, unit=self.config.unit, up=self.config.up)
        used = {name for names in joint_map.sources for name in names}
        free = [name for name in motion.joints if name not in used and name not in joint_map.unmapped]
        twice = sorted({name for name in free if motion.joints.count(name) > 1})
        remarks = []
        if free:
            more = f" and {len(free) - _NAMED_JOINTS} more" if len(free) > _NAMED_JOINTS else ""
            remarks.append(f"joints that no row of the map names: {', '.join(free[:_NAMED_JOINTS])}{more}")
        if twice:
            remarks.append(f"joints that appear more than once, which no row can name: {', '.join(twice)}")
        names = tuple(names[0] if len(names) == 1 else names for names in joint_map.sources)
        return SourceJoints(joints, self.config.source_fps or motion.fps, names, tuple(remarks))

    def _read(self, clip: BvhClip) -> bytes:
        batch = clip.batch
        if batch.archive is None:  # no need to read the loose files before it
            batch = Batch(batch.root, None, (clip.found.path,))
        for file in batch.read(SUFFIX):
            if file.path == clip.found.path and not file.error:
                return file.data
        raise UserError(f"{clip.label()}: no longer in the source")

    def take(self, clip: BvhClip, folder: Path) -> Sample:
        """One clip from the files of the features step."""
        return self._sample(clip, stored_features(_path(folder, clip.number), clip.label()))

    def features(self, label: str, data: bytes) -> NDArray[np.float32]:
        """Features [T', D] of one file; `label` names it in errors."""
        config = self.config
        motion = read_bvh(data, name=label)
        joints = self.maps.of(motion).apply(motion, unit=config.unit, up=config.up)
        try:
            if len(self.layout.skeleton) > joints.shape[1]:
                joints = with_resting_hands(joints)
            return features_of(
                joints, config.source_fps or motion.fps, self.layout, same_bones=config.retarget
            )
        except UserError as error:
            raise UserError(f"{label}: {error} (read with unit '{config.unit}', up '{config.up}')") from None

    def _sample(self, clip: BvhClip, motion: NDArray[np.float32]) -> Sample:
        layout = self.layout
        meta = layout.clip_meta(
            clip.id,
            source=clip.label(),
            split=clip.split,
            frames=len(motion),
            licence=self.config.licence,
            has_hands=layout.num_joints > BODY_JOINTS and self.config.fingers != "missing",
            has_face=False,
        )
        return Sample(meta=meta, motion=motion, texts=list(clip.texts))


@dataclass(frozen=True)
class BvhBatch:
    """One archive, or a run of loose files: read once, all its clips converted on the way."""

    clips: BvhClips
    batch: Batch
    number: int
    labels: tuple[str, ...]
    options: str
    """Digest of what the features depend on, the content of the source included."""

    @property
    def size(self) -> int:
        """Number of clips."""
        return len(self.labels)

    def is_made(self, folder: Path) -> bool:
        """Whether an earlier run made it from the same inputs."""
        return stored_batch(_path(folder, self.number), self._fingerprint()) is not None

    def make(self, folder: Path) -> None:
        """Convert the clips into a batch file."""
        dim, fingerprint = self.clips.layout.dim, self._fingerprint()
        store_batch(_path(folder, self.number), self._made(), dim=dim, fingerprint=fingerprint)

    def trial(self, seconds: float) -> int:
        """Convert clips for about this long without keeping them; returns how many."""
        end = time.perf_counter() + seconds
        for count, _ in enumerate(self._made(), start=1):
            if time.perf_counter() > end:
                return count
        return self.size

    def _fingerprint(self) -> str:
        return sha256_of_json([CONVERTER_VERSION, self.options, self.labels])

    def _made(self) -> Iterator[tuple[str, NDArray[np.float32] | Dropped]]:
        waiting = set(self.labels)
        try:
            for file in self.batch.read(SUFFIX):
                if file.label not in waiting:  # a second member of the same name finds nothing
                    continue
                waiting.remove(file.label)
                try:
                    if file.error:
                        raise UserError(f"{file.label}: {file.error}")
                    yield file.label, self.clips.features(file.label, file.data)
                except MemoryError:
                    raise
                except Exception as error:  # whatever a bad file makes of the libraries below
                    yield file.label, drop(file.label, error)
                if not waiting:
                    return
        except UserError as error:
            for label in self.labels:
                if label in waiting:
                    yield label, drop(label, error)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.bin"
