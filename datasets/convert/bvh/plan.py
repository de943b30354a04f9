"""BVH conversion, planning: options, and a plan of what becomes of every file of the source."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from pydantic import Field

from motionloom.datasets.convert.bvh.maps import SUFFIX, MapChoice, skeleton_key
from motionloom.datasets.convert.common.archives import Batch, list_batches
from motionloom.datasets.convert.common.caption_options import CaptionConfig, digest_of, settle_captions
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.plan import ConversionPlan, PlanDraft
from motionloom.datasets.convert.common.scan import BatchScan, FoundFile, scan_batches
from motionloom.datasets.convert.common.splits import check_id, hash_split
from motionloom.datasets.motion.bvh_text import find_motion, load_text, parse_hierarchy
from motionloom.datasets.motion.joint_map import Unit, Up
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import Caption, Split, UserError


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
    fingers: Literal["recorded", "resting", "missing"] = Field("recorded", json_schema_extra={"later": True})
    """Of layouts with hands: the files have them (`recorded`, which needs a joint map with fingers); they
    have none, and each clip gets hands at rest, which count as motion (`resting`) or do not (`missing`).
    """

    def motion_layout(self) -> MotionLayout:
        """The layout of the written shards."""
        layout = super().motion_layout()
        if layout.family == "raw":
            raise UserError(f"layout {self.layout} cannot be made from joints; use body133 or h3d263")
        return layout

    def mapped_skeleton(self) -> Skeleton:
        """The skeleton that the joint map reads: without fingers where the files have none."""
        own = self.motion_layout().skeleton
        return own if self.fingers == "recorded" else Skeleton.named("smpl22")

    def options(self, *local: str) -> dict[str, Any]:
        """What the output depends on, for the manifest: files by name and checksum instead of local paths."""
        given = super().options(*local)
        for key in ("joint_map", "captions"):
            path: MapChoice | None = getattr(self, key)
            if path != "auto":
                given[key] = digest_of(path) if path else None
        given["splits"] = bool(self.splits)
        if self.fingers == "recorded":  # as before there was a choice: shards made then stay valid
            del given["fingers"]
        return given


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
        """Name of the clip in reports."""
        return self.found.label


def plan_bvh(
    config: BvhConfig, *, workers: int = 1, progress: bool = False, scan: Path | None = None
) -> ConversionPlan[BvhClip]:
    """Find every clip and decide what becomes of it, without converting anything.

    `scan` is a file that remembers what unchanged files hold.
    """
    batches, ignored = list_batches(config.source, SUFFIX)
    scans = scan_batches(batches, SUFFIX, _header, keep=scan, workers=workers, progress=progress)
    return _decide(config, batches, scans, ignored)


def _header(data: bytes, label: str) -> tuple[int, float, str]:
    text, where = load_text(data, label)
    section = find_motion(text, where)
    key = ""
    with suppress(UserError):  # a broken hierarchy is reported when the clip is converted
        joints = parse_hierarchy(text[: section.start], where)
        key = skeleton_key(joints.names, joints.parents)
    return section.frames, section.fps, key


def _decide(
    config: BvhConfig, batches: list[Batch], scans: list[BatchScan], ignored: int
) -> ConversionPlan[BvhClip]:
    """Which of the files found become samples, in which split."""
    found = [(number, file) for number, scan in enumerate(scans) for file in scan.files]
    refused = config.licence_problem(config.licence)
    table = config.matched(file.path for _, file in found)
    listed, notes = config.listed_splits()
    broken = [scan.problem for scan in scans if scan.problem is not None]
    draft: PlanDraft[BvhClip] = PlanDraft(config, broken=broken, notes=notes)
    ids: dict[str, str] = {}
    contents: dict[str, str] = {}
    unreadable: set[str] = set()
    other_rate = captioned = 0
    bare_clips: list[str] = []
    # Captioned files first, so that a stray copy never takes the place of the clip that has captions.
    for number, clip in sorted(found, key=lambda pair: pair[1].path not in table.rows):
        row = table.rows.get(clip.path)
        try:
            clip_id = row.id if row else check_id(str(PurePosixPath(clip.path).with_suffix("")), clip.label)
        except UserError as error:
            draft.fail(clip.label, error)
            continue
        if clip.problem:
            unreadable.add(clip_id)
            draft.fail(clip.label, UserError(clip.problem))
            continue
        texts = row.texts if row else ()
        if config.captions and not texts:
            draft.uncaptioned.append(clip.label)
        other_rate += bool(row and row.fps and abs(row.fps - clip.fps) > 0.01 * clip.fps)
        if clip_id in ids:
            reason = f"second file for clip id '{clip_id}'; the first is {ids[clip_id]}"
        elif clip.sha256 in contents:
            reason = f"same bytes as {contents[clip.sha256]}"
        elif config.splits and clip_id not in listed:
            reason = "in no split file"
        elif row and row.left_out:
            reason = "in a split that is left out (splits_map)"
        else:
            reason = refused or config.length_problem(clip.frames / (config.source_fps or clip.fps))
        ids.setdefault(clip_id, clip.label)
        contents.setdefault(clip.sha256, clip.label)
        captioned += bool(texts) and not reason
        if config.captions and not texts and not reason:
            bare_clips.append(clip.label)
            reason = "" if config.uncaptioned == "keep" else "no captions"
        if reason:
            draft.leave_out(clip.label, reason)
            continue
        split = listed.get(clip_id) or (row.split if row else None) or hash_split(clip_id)
        draft.take(BvhClip(batches[number], number, clip, clip_id, split, texts))
    if other_rate:
        draft.notes.append(
            f"{other_rate} captions state another frame rate than their file; the file's counts"
        )
    draft.limit(lambda clip: clip.id)
    settle_captions(config, draft, table, bare_clips, captioned)
    wanted = {row.id: row.file or row.id for row in table.unused}
    wanted |= {clip_id: clip_id for clip_id in listed if clip_id not in wanted}
    for clip_id, name in wanted.items():
        if clip_id not in ids and clip_id not in unreadable:
            draft.miss(name, f"clip '{clip_id}' is listed, but its file is not in the source")
    layout = config.motion_layout()
    return draft.finish(
        found=len(found),
        frames=lambda clip: frames_after(clip.found.frames, config.source_fps or clip.found.fps, layout),
        licence=lambda clip: config.licence,
        ignored=ignored,
    )
