"""AMASS conversion, planning: options, the motion files of a source, and what becomes of each.

Files that may be used are opened, but only for their headers and a few scalars.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import Field, model_validator

from motionloom.datasets.convert.amass.index import INDEX_FPS, IndexRow, clip_key, read_index, thinning
from motionloom.datasets.convert.amass.smpl_npz import MotionHeader, read_motion_header
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.captions.options import CaptionConfig, CaptionedPlan, settle_captions
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.files import check_id, inside, read_in_threads
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.splits import (
    hash_split,
    keep_mirrors_together,
    original_of,
    read_split_files,
)
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.schema import Caption, Dropped, Split, UserError
from motionloom.datasets.shards.left_out import drop

SUFFIX = ".npz"
LICENCE = "AMASS-noncommercial"
"""Stated for every subset. The motions come from many laboratories with terms of their own, some of them
freer, but the fits are AMASS's: non-commercial research only, and not to be passed on.
"""


class AmassConfig(CaptionConfig):
    """AMASS, or any folder tree of SMPL, SMPL-H or SMPL-X clips in .npz files (`SUBSET/subject/clip.npz`)."""

    layouts = ("body133", "wholebody313", "h3d263", "tomato623", "smpl75")
    everyday = ("captions",)

    name: str = "amass"
    layout: str = "body133"
    """`body133` or `h3d263`; `wholebody313` has the fingers too; `smpl75` keeps the parameters, for UDE."""
    fps: float = Field(default=20.0, gt=0, le=240)
    body_model: Path | None = None
    """Your SMPL-H, SMPL-X or SMPL model (.npz) for clips of any gender. Without one, poses keep their
    rotations and take the bone lengths of one neutral adult.
    """
    body_model_female: Path | None = None
    """The same, for female clips."""
    body_model_male: Path | None = None
    """The same, for male clips."""
    humanml_index: Path | None = None
    """HumanML3D's `index.csv`: convert its clips (cut, and named by its numbers) instead of whole files."""
    humanml_texts: Path | None = None
    """HumanML3D's folder of texts, for the clips of `humanml_index`."""
    mirror: bool = False
    """With `humanml_index`: also the mirrored clips (`M...`), which have texts of their own there."""
    up: Literal["z", "y"] = "z"
    """The axis that points up in the files; AMASS's is z."""
    source_fps: float | None = Field(default=None, ge=1, le=10_000)
    """Overrides the files' frame rate, for collections that state a wrong one or none."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton (h3d features always do)."""

    @model_validator(mode="after")
    def _consistent(self) -> AmassConfig:
        if self.humanml_index is None and (self.mirror or self.humanml_texts is not None):
            raise ValueError("mirror and humanml_texts need humanml_index")
        if self.humanml_index is not None and self.captions is not None:
            raise ValueError("captions and humanml_index exclude each other; the index has humanml_texts")
        return self

    @property
    def has_captions(self) -> bool:
        return self.captions is not None or self.humanml_texts is not None


@dataclass(frozen=True)
class AmassFile:
    """A motion file as the scan finds it."""

    path: Path
    label: str
    """Path in the source."""
    size: int

    @property
    def id(self) -> str:
        return self.label.removesuffix(SUFFIX)

    @property
    def subset(self) -> str:
        """Folder of the release: the third name from the end."""
        parts = PurePosixPath(self.label).parts
        return parts[-3] if len(parts) > 2 else "."


def list_files(source: Path) -> tuple[list[AmassFile], list[Dropped]]:
    """Motion files in name order, and what cannot be opened.

    Files that hold the shape of a subject without motion (`shape.npz`, `..._stagei.npz`) are none.
    """
    if not source.is_dir():
        raise UserError(f"{source}: no such folder")
    files: list[AmassFile] = []
    broken: list[Dropped] = []
    for folder, folders, names in os.walk(source):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in (*names, *links):
            path = Path(folder) / name
            relative = path.relative_to(source).as_posix()
            label = relative.encode("utf-8", "backslashreplace").decode()  # names may be any bytes
            if name in links:
                reason = "a link to a folder, which is not followed; put the folder in its place"
                broken.append(Dropped(source=label, reason=reason))
            elif name.endswith(SUFFIX) and name != "shape.npz" and not name.endswith("_stagei.npz"):
                try:
                    check_id(relative, label)
                    files.append(AmassFile(path, label, inside(source, relative).stat().st_size))
                except (UserError, OSError) as error:
                    broken.append(drop(label, error))
    if not files:
        raise UserError(f"{source}: no {SUFFIX} file with motion in it")
    return sorted(files, key=lambda file: file.label), sorted(broken, key=lambda drop: drop.source)


def read_headers(
    files: Sequence[AmassFile], settings: PlanSettings, draft: Draft
) -> list[tuple[AmassFile, MotionHeader]]:
    """The files that can be read, with what they state; the others are broken."""
    out: list[tuple[AmassFile, MotionHeader]] = []
    headers = read_in_threads(_read, files, workers=settings.workers, progress=settings.progress)
    for file, header in zip(files, headers, strict=True):
        if isinstance(header, UserError):
            draft.fail(file.label, header)
        else:
            out.append((file, header))
    return out


def _read(file: AmassFile) -> MotionHeader | UserError:
    try:
        return read_motion_header(file.path, file.label)
    except UserError as error:
        return error


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
        return (self.last - self.first) / self.fps

    @property
    def facts(self) -> dict[str, str | float]:
        about = {"subset": self.file.subset, "gender": self.header.gender, "model": self.header.kind}
        return {**about, "seconds": self.seconds, "fps": self.fps}

    def label(self) -> str:
        return self.file.label if self.id == self.file.id else f"{self.file.label} ({self.id})"


Draft = CaptionedPlan[AmassClip]


def plan_amass(
    config: AmassConfig, models: Mapping[str, str], settings: PlanSettings
) -> ConversionPlan[AmassClip]:
    """Find every clip and decide what becomes of it. `models` is the kind of the body model by gender."""
    layout = config.motion_layout()
    files, broken = list_files(config.source)
    draft = Draft(config, broken=broken)
    if config.humanml_index is not None:
        clips = _index_clips(config, config.humanml_index, files, draft, settings)
    else:
        clips = _whole_clips(config, files, draft, settings)
    for clip, reason in clips:
        reason = (
            reason
            or _body_problem(config, models, clip.header)
            or config.licence_problem(config.licence or LICENCE)
            or config.length_problem(clip.seconds)
        )
        draft.decide(clip, clip.texts, reason)
    draft.limit(AmassClip.label)
    return draft.finish(
        found=len(files),
        frames=lambda clip: frames_after(clip.last - clip.first, clip.fps, layout),
        licence=lambda clip: config.licence or LICENCE,
    )


def _whole_clips(
    config: AmassConfig, files: list[AmassFile], draft: Draft, settings: PlanSettings
) -> Iterator[tuple[AmassClip, str]]:
    """Every file as one clip, and why it must be left out."""
    headers = read_headers(files, settings, draft)
    listing = config.listing([file.label for file in files])
    draft.notes += listing.notes
    for file, header in headers:
        fps = _rate(config, file, header, draft)
        if not fps:
            continue
        clip_id = listing.id_of(file.label)
        split, texts = listing.split_of(file.label), listing.texts_of(file.label)
        clip = AmassClip(file, clip_id, split, header, fps, 0, header.frames, texts)
        yield clip, listing.problem(file.label)
    settle_captions(config, draft, listing)


def _index_clips(
    config: AmassConfig, index: Path, files: list[AmassFile], draft: Draft, settings: PlanSettings
) -> Iterator[tuple[AmassClip, str]]:
    """Every row of the index as one clip, or two with `mirror`."""
    rows = read_index(index)
    listed: dict[str, Split] = {}
    if config.splits is not None:
        listed, notes = read_split_files(config.splits)
        keep_mirrors_together(listed, config.splits)
        draft.notes += notes
    by_file = _rows_by_file(rows, files, draft)
    for file, header in read_headers([file for file in files if file.label in by_file], settings, draft):
        fps = _rate(config, file, header, draft)
        for row in by_file[file.label] if fps else ():
            first, last = row.cut(header.frames, fps)
            beyond = "" if last > first else f"the index cuts beyond the {header.frames} frames of the file"
            # Stretches of one file may overlap: without split files they stay together.
            split = listed.get(row.id) or listed.get(f"M{row.id}") or hash_split(clip_key(row.source))
            for clip_id, original in [(row.id, None), (f"M{row.id}", row.id)][: 1 + config.mirror]:
                texts, reason = _index_texts(config, clip_id, last - first, fps, draft.notes)
                clip = AmassClip(file, clip_id, split, header, fps, first, last, texts, original)
                unlisted = "in no split file" if config.splits and clip_id not in listed else ""
                yield clip, unlisted or beyond or reason
    known = {row.id for row in rows}
    for clip_id in listed:
        if clip_id not in known and (original_of(clip_id) or clip_id) not in known:
            draft.miss(clip_id, "in a split file, but not in the index")


def _rows_by_file(rows: list[IndexRow], files: list[AmassFile], draft: Draft) -> dict[str, list[IndexRow]]:
    """Rows of every file (by label); rows without a file and files without a row are reported."""
    by_key: dict[str, AmassFile] = {}
    found: dict[str, list[IndexRow]] = {}
    for file in files:
        first = by_key.setdefault(clip_key(file.label), file)
        if first is not file:
            draft.leave_out(file.label, f"the same clip as {first.label}")
    # Rows whose recordings are no part of AMASS are told apart from files that the user lacks.
    for row in rows:
        match = by_key.get(clip_key(row.source))
        if match is not None:
            found.setdefault(match.label, []).append(row)
            continue
        why = "HumanAct12 is not part of AMASS" if row.subset == "humanact12" else "its file is not here"
        draft.miss(row.source, f"clip '{row.id}' of the index: {why}")
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


def _rate(config: AmassConfig, file: AmassFile, header: MotionHeader, draft: Draft) -> float:
    """Frames a second; 0, with the file among the broken, when neither states one."""
    fps = config.source_fps or header.fps or 0.0
    if not fps:
        draft.fail(file.label, UserError("no mocap_framerate and no mocap_frame_rate in it; set source_fps"))
    return fps


def _body_problem(config: AmassConfig, models: Mapping[str, str], header: MotionHeader) -> str:
    """Return the reason that parameters do not fit layout or body models; empty when they do."""
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
