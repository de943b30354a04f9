"""AMASS conversion, planning: a plan of what becomes of every file of the source.

Files that may be used are opened, but only for their headers and a few scalars.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from motionloom.datasets.convert.amass.index import INDEX_FPS, IndexRow, clip_key, read_index, thinning
from motionloom.datasets.convert.amass.source import (
    LICENCE,
    SUFFIX,
    AmassConfig,
    AmassFile,
    list_files,
    read_headers,
)
from motionloom.datasets.convert.common.caption_match import CaptionMatch
from motionloom.datasets.convert.common.caption_options import settle_captions
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.plan import ConversionPlan, PlanDraft, Subset
from motionloom.datasets.convert.common.smpl_npz import MotionHeader
from motionloom.datasets.convert.common.splits import (
    hash_split,
    keep_mirrors_together,
    original_of,
)
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.schema import Caption, Split, UserError

_NOTED_LINES = 50
"""Wrong caption lines that are noted one by one."""


@dataclass(frozen=True)
class AmassClip:
    """A clip of the plan: frames [first, last) of a file."""

    file: AmassFile
    id: str
    split: Split
    header: MotionHeader
    fps: float
    """The file's frame rate, or the one that overrides it."""
    first: int
    last: int
    texts: tuple[Caption, ...] = ()
    mirror_of: str | None = None

    @property
    def seconds(self) -> float:
        """Length."""
        return (self.last - self.first) / self.fps

    def label(self) -> str:
        """Name of the clip in reports."""
        return self.file.label if self.id == self.file.id else f"{self.file.label} ({self.id})"


@dataclass
class _Draft(PlanDraft[AmassClip]):
    missing_in: Counter[str] = field(default_factory=Counter)
    """Missing clips a subset."""
    match: CaptionMatch = field(default_factory=CaptionMatch)
    """Captions of whole files."""


def plan_amass(
    config: AmassConfig, models: Mapping[str, str], *, workers: int = 1, progress: bool = False
) -> ConversionPlan[AmassClip]:
    """Find every clip and decide what becomes of it. `models` is the kind of the body model by gender."""
    layout = config.motion_layout()
    files, others, broken = list_files(config.source)
    listed, notes = config.listed_splits()
    draft = _Draft(config, broken=broken, notes=notes)
    if config.humanml_index is not None:
        clips = _index_clips(config, config.humanml_index, files, listed, draft, workers, progress)
    else:
        clips = _whole_clips(config, files, listed, draft, workers, progress)
    with_texts = config.captions is not None or config.humanml_texts is not None
    bare_clips: list[str] = []
    captioned = 0
    for clip, reason in clips:
        if with_texts and not clip.texts:
            draft.uncaptioned.append(clip.label())
        if config.splits is not None and clip.id not in listed:
            reason = reason or "in no split file"
        reason = (
            reason
            or _body_problem(config, models, clip.header)
            or config.licence_problem(config.licence or LICENCE)
            or config.length_problem(clip.seconds)
        )
        captioned += bool(clip.texts) and not reason
        if with_texts and not clip.texts and not reason:
            bare_clips.append(clip.label())
            reason = "" if config.uncaptioned == "keep" else "no captions"
        if reason:
            draft.leave_out(clip.label(), reason)
        else:
            draft.take(clip)
    settle_captions(config, draft, draft.match, bare_clips, captioned)
    draft.limit(AmassClip.label)
    return draft.finish(
        found=len(files),
        frames=lambda clip: frames_after(clip.last - clip.first, clip.fps, layout),
        licence=lambda clip: config.licence or LICENCE,
        ignored=others,
        subsets=_subsets(files, draft.items, draft.missing_in),
    )


def _whole_clips(
    config: AmassConfig,
    files: list[AmassFile],
    listed: Mapping[str, Split],
    draft: _Draft,
    workers: int,
    progress: bool,
) -> list[tuple[AmassClip, str]]:
    """Every file as one clip, with the reason against it if there is one already."""
    headers, broken = read_headers(files, workers, progress)
    draft.broken += broken
    draft.match = config.matched([file.label for file in files] + [drop.source for drop in draft.broken])
    clips: list[tuple[AmassClip, str]] = []
    seen: dict[str, str] = {}
    for file, header in headers:
        fps = _rate(config, file, header, draft)
        if not fps:
            continue
        row = draft.match.rows.get(file.label)
        clip_id = row.id if row else file.id
        texts = row.texts if row else ()
        split = listed.get(clip_id) or (row.split if row else None) or hash_split(clip_id)
        first = seen.setdefault(clip_id, file.label)
        reason = "" if first == file.label else f"second file for clip id '{clip_id}'; the first is {first}"
        if row and row.left_out:
            reason = reason or "in a split that is left out (splits_map)"
        clips.append((AmassClip(file, clip_id, split, header, fps, 0, header.frames, texts), reason))
    wanted = {row.id: row.file or f"{row.id}{SUFFIX}" for row in draft.match.unused}
    wanted |= {clip_id: f"{clip_id}{SUFFIX}" for clip_id in listed if clip_id not in wanted}
    here = {file.label for file in files} | {drop.source for drop in draft.broken}
    for clip_id, name in wanted.items():
        if clip_id not in seen and name not in here:
            draft.miss(name, f"clip '{clip_id}' is listed, but not here")
    return clips


def _index_clips(
    config: AmassConfig,
    index: Path,
    files: list[AmassFile],
    listed: Mapping[str, Split],
    draft: _Draft,
    workers: int,
    progress: bool,
) -> list[tuple[AmassClip, str]]:
    """Every row of the index as one clip, or two with `mirror`."""
    rows = read_index(index)
    if config.splits is not None:
        keep_mirrors_together(listed, original_of, config.splits)
    by_file = _rows_by_file(rows, files, draft)
    headers, broken = read_headers([file for file in files if file.label in by_file], workers, progress)
    draft.broken += broken
    clips: list[tuple[AmassClip, str]] = []
    problems: list[str] = []
    for file, header in headers:
        fps = _rate(config, file, header, draft)
        for row in by_file[file.label] if fps else ():
            first, last = row.cut(header.frames, fps)
            beyond = "" if last > first else f"the index cuts beyond the {header.frames} frames of the file"
            # Stretches of one file may overlap: without split files they stay together.
            split = listed.get(row.id) or listed.get(f"M{row.id}") or hash_split(clip_key(row.source))
            for clip_id, original in [(row.id, None), (f"M{row.id}", row.id)][: 1 + config.mirror]:
                texts, reason = _index_texts(config, clip_id, last - first, fps, problems)
                clip = AmassClip(file, clip_id, split, header, fps, first, last, texts, original)
                clips.append((clip, beyond or reason))
    known = {row.id for row in rows}
    for clip_id in listed:
        if clip_id not in known and (original_of(clip_id) or clip_id) not in known:
            draft.miss(clip_id, "in a split file, but not in the index")
    draft.notes += problems[:_NOTED_LINES]
    if len(problems) > _NOTED_LINES:
        draft.notes.append(f"and {len(problems) - _NOTED_LINES} more caption lines left out")
    return clips


def _rows_by_file(rows: list[IndexRow], files: list[AmassFile], draft: _Draft) -> dict[str, list[IndexRow]]:
    """Rows of every file (by label); rows without a file and files without a row are reported."""
    by_key: dict[str, AmassFile] = {}
    found: dict[str, list[IndexRow]] = {}
    here = {clip_key(file.label).split("/")[0]: file.subset for file in files}
    for file in files:
        first = by_key.setdefault(clip_key(file.label), file)
        if first is not file:
            draft.leave_out(file.label, f"the same clip as {first.label}")
    for row in rows:
        match = by_key.get(clip_key(row.source))
        if match is not None:
            found.setdefault(match.label, []).append(row)
            continue
        why = "HumanAct12 is not part of AMASS" if row.subset == "humanact12" else "its file is not here"
        draft.miss(row.source, f"clip '{row.id}' of the index: {why}")
        draft.missing_in[here.get(row.subset, row.subset)] += 1
    for file in by_key.values():
        if file.label not in found:
            draft.leave_out(file.label, "in no row of the index")
    return found


def _index_texts(
    config: AmassConfig, clip_id: str, frames: int, fps: float, problems: list[str]
) -> tuple[tuple[Caption, ...], str]:
    """Captions of a clip of the index, in its own seconds, and why it must be left out."""
    if config.humanml_texts is None or not (path := config.humanml_texts / f"{clip_id}.txt").is_file():
        return (), ""
    # The texts count seconds as frames / 20; a file thinned to 20.83 frames a second is a little shorter.
    scale = INDEX_FPS * thinning(fps) / fps
    try:
        captions, wrong = read_humanml_captions(path, seconds=frames / fps / scale, name=path.name)
    except UserError as error:
        return (), str(error)
    problems += [f"{path.name}: {problem}" for problem in wrong]
    if abs(scale - 1.0) > 1e-6:
        captions = [
            caption.model_copy(
                update={"start": caption.start * scale, "end": caption.end and caption.end * scale}
            )
            for caption in captions
        ]
    return tuple(captions), ""


def _rate(config: AmassConfig, file: AmassFile, header: MotionHeader, draft: _Draft) -> float:
    """Frames a second; 0, with the file among the broken, when neither states one."""
    fps = config.source_fps or header.fps or 0.0
    if not fps:
        draft.fail(file.label, UserError("no mocap_framerate and no mocap_frame_rate in it; set source_fps"))
    return fps


def _body_problem(config: AmassConfig, models: Mapping[str, str], header: MotionHeader) -> str:
    """Why the parameters do not fit the layout or the body models; empty when they do."""
    if config.motion_layout().num_joints > BODY_JOINTS and not header.hands:
        return f"{header.kind} without finger rotations; layout {config.layout} has fingers"
    if not models:
        return ""
    kind = models.get(header.gender) or models.get("neutral")
    if kind is None:
        return f"no body model for gender '{header.gender}'; set body_model, which serves all"
    if (kind == "SMPL-X") != (header.kind == "SMPL-X"):
        return f"{header.kind} parameters, but the body model is {kind}: their shapes and rest poses differ"
    return ""


def _subsets(
    files: list[AmassFile], items: list[tuple[Split, AmassClip]], missing: Counter[str]
) -> dict[str, Subset]:
    found = Counter(file.subset for file in files)
    used = Counter(file.subset for file in {clip.file for _, clip in items})
    return {name: Subset(found[name], used[name], missing[name]) for name in sorted(found | missing)}
