"""BVH conversion, planning: options, the joint map of each skeleton, and what becomes of every file.

Clips have one skeleton when names and parents of their joints are the same; bone lengths may differ. A
skeleton is guessed once, from the first clip of the plan that has it, so that the number of workers and the
order of their work change nothing.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from motionloom.datasets.base.files import sha256_of_json, write_text
from motionloom.datasets.convert.bvh.joint_guess.guess import JointGuess, guess_joint_map
from motionloom.datasets.convert.captions.options import CaptionConfig, CaptionedPlan, settle_captions
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.files import check_id
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.scan import Batch, BatchScan, FoundFile, list_batches, scan_batches
from motionloom.datasets.motion.bvh.joint_map import JointMap, Unit, Up
from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh
from motionloom.datasets.motion.bvh.text import find_motion, load_text, parse_hierarchy
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import Caption, Split, UserError

MapChoice = Annotated[
    Path | Literal["auto"], BeforeValidator(lambda given: "auto" if str(given) == "auto" else given)
]
"""A map file, or `auto` (from the command line also as a path) for one that is guessed."""

SUFFIX = ".bvh"


@dataclass(frozen=True)
class JointMaps:
    """The joint maps of a conversion."""

    given: JointMap | None
    """The user's, for every clip."""
    guessed: Mapping[str, JointMap]
    """By `skeleton_key`, where none is given."""

    def of(self, motion: BvhMotion) -> JointMap:
        if self.given is not None:
            return self.given
        try:
            return self.guessed[skeleton_key(motion.joints, motion.parents)]
        except KeyError:
            raise UserError(
                f"{motion.name}: its skeleton was not there when the source was planned"
            ) from None


def skeleton_key(joints: Sequence[str], parents: Sequence[int]) -> str:
    """What clips with one skeleton share."""
    return sha256_of_json([list(joints), list(parents)])[:16]


def guess_maps(
    clips: Iterable[tuple[Batch, str, str]], target: Skeleton, source: Path, folder: Path | None
) -> dict[str, JointGuess]:
    """A certain guess for every skeleton of the planned clips (batch, label, skeleton's key).

    With `folder` each is written there as a map file. `UserError` when one is not certain, or when another
    map lies there already: it may have been corrected by hand.
    """
    wanted: dict[Batch, dict[str, str]] = {}
    for batch, label, key in clips:
        wanted.setdefault(batch, {})[label] = key
    guesses: dict[str, JointGuess] = {}
    for batch, labels in wanted.items():
        missing = {key for key in labels.values() if key} - set(guesses)
        with suppress(UserError):  # a damaged archive; its clips are reported when they are converted
            for file in batch.read(SUFFIX) if missing else ():
                if labels.get(file.label) not in missing:
                    continue
                with suppress(UserError):  # likewise; the next clip of this skeleton may be whole
                    guess = guess_joint_map(read_bvh(file.data, name=file.label), target)
                    guesses[labels[file.label]] = guess
                    missing.remove(labels[file.label])
                if not missing:
                    break
    written = {key: _written(guess, number, folder) for number, (key, guess) in enumerate(guesses.items(), 1)}
    for key, guess in guesses.items():
        if not guess.certain:
            which = f" (skeleton of {guess.source})" if len(guesses) > 1 else ""
            raise UserError(
                f"{source}: the joint map{which} is not certain: {guess.doubts()}; {written[key]}"
            )
    return guesses


def map_name(number: int) -> str:
    """File name of the map of the n-th skeleton of a source."""
    return "joint_map.json" if number == 1 else f"joint_map-{number}.json"


def guess_source(source: Path, target: Skeleton) -> JointGuess:
    """The guess for the first clip of a .bvh file, of a folder of such files, or of an archive."""
    batches = list_batches(source, SUFFIX)
    for batch in batches:
        for file in batch.read(SUFFIX):
            if file.error:
                raise UserError(f"{file.label}: {file.error}")
            return guess_joint_map(read_bvh(file.data, name=file.label), target)
    raise UserError(f"{source}: no {SUFFIX} file in it")


def _written(guess: JointGuess, number: int, folder: Path | None) -> str:
    if folder is None:
        return f"`motionloom data joints {guess.source} -o joint_map.json` writes a map to complete"
    path = folder / map_name(number)
    name = guess.target.name
    if path.exists():
        try:
            rows = json.loads(path.read_text(encoding="utf-8-sig")).get(name)
        except (OSError, ValueError, AttributeError):
            rows = None
        if rows != json.loads(guess.text())[name]:
            raise UserError(
                f"{path}: not the joint map that is guessed; use it with --joint-map {path}, or delete it"
            )
    else:
        write_text(path, guess.text())
    return f"complete {path} and pass it with --joint-map {path}"


class BvhConfig(CaptionConfig):
    """Options of the BVH converter."""

    source: Path
    """A folder of .bvh files and/or tar archives of them, or one such file."""
    joint_map: MapChoice = "auto"
    """`auto`, or a JSON file that says which joints of the files stand for ours (docs/sources.md)."""
    name: str = "bvh"
    """Name of the data set; part of the shards' file names."""
    licence: str
    """Licence of the clips, kept in every sample."""
    layout: str = "body133"
    """Feature layout of the shards: body133, h3d263, or one with hands and a face."""
    fps: float = Field(default=20.0, gt=0, le=240)
    """Frame rate of the shards; clips are resampled by time."""
    source_fps: float | None = Field(default=None, gt=0)
    """True frame rate of the files, for collections that state a wrong one."""
    unit: Unit = "cm"
    """Length unit of the files."""
    up: Up = "y"
    """Upward axis of the files."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton."""
    fingers: Literal["recorded", "resting", "missing"] = "recorded"
    """Of layouts with hands: the files have them (`recorded`, which needs a joint map with fingers); they
    have none, and each clip gets hands at rest, which count as motion (`resting`) or do not (`missing`).
    """

    def motion_layout(self) -> MotionLayout:
        layout = super().motion_layout()
        if layout.family == "raw":
            raise UserError(f"layout {self.layout} cannot be made from joints; use body133 or h3d263")
        return layout

    def mapped_skeleton(self) -> Skeleton:
        """The skeleton that the joint map reads: without fingers where the files have none."""
        own = self.motion_layout().skeleton
        return own if self.fingers == "recorded" else Skeleton.named("smpl22")


@dataclass(frozen=True)
class BvhClip:
    """A clip of the plan."""

    batch: Batch
    number: int
    """Position of its batch in the source."""
    found: FoundFile
    id: str
    split: Split
    texts: tuple[Caption, ...]

    @property
    def subset(self) -> str:
        """Its archive, or the folder at the top of the source that it lies in; empty for neither."""
        folders = PurePosixPath(self.found.path).parts[:-1]
        return self.batch.archive or (folders[0] if folders else "")

    def label(self) -> str:
        return self.found.label


def plan_bvh(config: BvhConfig, settings: PlanSettings) -> ConversionPlan[BvhClip]:
    """Find every clip and decide what becomes of it, without converting anything."""
    batches = list_batches(config.source, SUFFIX)
    scans = scan_batches(
        batches, SUFFIX, _header, keep=settings.scan, workers=settings.workers, progress=settings.progress
    )
    return _decide(config, batches, scans)


def _header(data: bytes, label: str) -> tuple[int, float, str]:
    text, where = load_text(data, label)
    section = find_motion(text, where)
    key = ""
    with suppress(UserError):  # a broken hierarchy is reported when the clip is converted
        joints = parse_hierarchy(text[: section.start], where)
        key = skeleton_key(joints.names, joints.parents)
    return section.frames, section.fps, key


def _decide(config: BvhConfig, batches: list[Batch], scans: list[BatchScan]) -> ConversionPlan[BvhClip]:
    found = [(number, file) for number, scan in enumerate(scans) for file in scan.files]
    refused = config.licence_problem(config.licence)
    listing = config.listing([file.path for _, file in found])
    broken = [scan.problem for scan in scans if scan.problem is not None]
    draft = CaptionedPlan[BvhClip](config, broken=broken, notes=listing.notes)
    ids: dict[str, str] = {}
    contents: dict[str, str] = {}
    other_rate = 0
    # Captioned files first, so that a stray copy never takes the place of the clip that has captions.
    for number, clip in sorted(found, key=lambda pair: pair[1].path not in listing.rows):
        clip_id = listing.id_of(clip.path)
        try:
            check_id(clip_id, clip.label)
            if clip.problem:
                raise UserError(clip.problem)
        except UserError as error:
            draft.fail(clip.label, error)
            continue
        stated = listing.rows[clip.path].fps if clip.path in listing.rows else None
        other_rate += stated is not None and abs(stated - clip.fps) > 0.01 * clip.fps
        if clip_id in ids:
            reason = f"second file for clip id '{clip_id}'; the first is {ids[clip_id]}"
        elif clip.sha256 in contents:
            reason = f"same bytes as {contents[clip.sha256]}"
        else:
            seconds = clip.frames / (config.source_fps or clip.fps)
            reason = listing.problem(clip.path) or refused or config.length_problem(seconds)
        ids.setdefault(clip_id, clip.label)
        contents.setdefault(clip.sha256, clip.label)
        texts = listing.texts_of(clip.path)
        made = BvhClip(batches[number], number, clip, clip_id, listing.split_of(clip.path), texts)
        draft.decide(made, texts, reason)
    if other_rate:
        draft.notes.append(
            f"{other_rate} captions state another frame rate than their file; the file's counts"
        )
    draft.limit(lambda clip: clip.id)
    settle_captions(config, draft, listing)
    layout = config.motion_layout()
    return draft.finish(
        found=len(found),
        frames=lambda clip: frames_after(clip.found.frames, config.source_fps or clip.found.fps, layout),
        licence=lambda clip: config.licence,
    )
