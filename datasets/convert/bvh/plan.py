"""BVH conversion, planning: what becomes of every file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.bvh.config import BvhClip, BvhConfig
from motionloom.datasets.convert.bvh.maps import JointMaps, choose_maps
from motionloom.datasets.convert.bvh.read import FoundFile, scan_files
from motionloom.datasets.convert.captions.humanml_index import (
    ORIGINALS,
    find_originals,
    index_clips,
    settle_index,
)
from motionloom.datasets.convert.captions.options import settle_captions
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.files import check_id
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.tables import captions_within
from motionloom.datasets.motion.bvh.joint_map import JointMap


def plan_bvh(
    config: BvhConfig, own_maps: Sequence[JointMap], settings: PlanSettings, stated: str
) -> tuple[ConversionPlan[BvhClip], JointMaps]:
    """Find every clip and decide what becomes of it, without converting anything; and the joint maps."""
    folder, names = config.files()
    found = scan_files(folder, names, workers=settings.workers, progress=settings.progress)
    if config.humanml_index is None:
        draft = _decide(config, folder, found, stated)
    else:
        draft = ConversionPlan[BvhClip](config, stated=stated)
        _decide_by_index(config, config.humanml_index, folder, found, draft)
    if folder != config.source and folder.is_relative_to(config.source):
        draft.base = f"{folder.relative_to(config.source).as_posix()}/"
    maps = choose_maps(config, own_maps, draft, settings.maps)
    draft.limit()
    if miscounted := [file.path for file in found if file.miscounted]:
        draft.notes.append(
            f"'Frames:' is a row off in {len(miscounted)} of the files (the first: {miscounted[0]}); "
            "all their rows are read"
        )
    layout = config.motion_layout()
    draft.finish(
        found=len(names),
        frames=lambda clip: frames_after(clip.frames, clip.fps, layout),
        licence=lambda clip: clip.licence or "not stated yet",
    )
    return draft, maps


def _decide(config: BvhConfig, folder: Path, found: list[FoundFile], stated: str) -> ConversionPlan[BvhClip]:
    listing = config.listing([file.path for file in found])
    draft = ConversionPlan[BvhClip](config, notes=listing.notes, stated=stated)
    names = {PurePosixPath(file.path).stem for file in found}
    # A file that is here is left out for its row.
    draft.mark_rows_unreadable({name: why for name, why in config.bad_rows.items() if name not in names})
    contents: dict[str, str] = {}
    # Captioned files first, so that a stray copy never takes the place of the clip that has captions.
    for clip in sorted(found, key=lambda file: file.path not in listing.rows):
        clip_id = listing.id_of(clip.path)
        try:
            check_id(clip_id, clip.path)
            if clip.problem:
                raise UserError(clip.problem)
        except UserError as error:
            draft.mark_unreadable(clip.path, error)
            continue
        frames = len(range(clip.frames)[config.cut(clip.path)])
        fps = config.source_fps or clip.fps
        same = contents.setdefault(clip.sha256, clip.path)
        reason = (
            (f"same bytes as {same}" if same != clip.path else "")
            or config.unfit(clip.path)
            or listing.problem(clip.path)
            or config.length_problem(frames / fps)
        )
        notes = [] if reason else draft.notes
        texts = captions_within(listing.texts_of(clip.path), frames / fps, clip_id, notes)
        split = listing.split_of(clip.path)
        about = config.about(clip.path)
        planned = BvhClip(folder, clip, clip_id, split, texts, frames, fps, about, config.licence)
        keep = config.uncaptioned == "keep"
        draft.add(planned, reason, captioned=bool(texts), wanted=config.has_captions, keep=keep)
    settle_captions(config, draft, listing)
    return draft


def _decide_by_index(
    config: BvhConfig, index: Path, folder: Path, scan: list[FoundFile], draft: ConversionPlan[BvhClip]
) -> None:
    """Plan the clips that HumanML3D's index cuts from the free originals."""
    files = {file.path: file for file in scan}
    for file in files.values():
        if file.problem:
            draft.mark_unreadable(file.path, UserError(file.problem))
    found = find_originals(config, index, files, draft)
    listed, notes = config.index_splits()
    draft.notes += notes
    apart: list[str] = []
    for one in index_clips(config, found, listed):
        file = files[one.file or ""]
        row = one.row
        if file.problem:
            continue
        fps = config.source_fps or row.true_fps(file.fps)
        first, last, wrong = row.span(file.frames, fps)
        texts, broken = config.index_texts(one.id, (last - first) / fps, draft.notes)
        clip = BvhClip(
            folder, file, one.id, one.split, texts, last - first, fps, {"subset": row.subset},
            ORIGINALS[row.subset], (first, last), one.mirror_of,
        )  # fmt: skip
        apart += [f"{clip.label()}: {wrong}"] if wrong else []
        unlisted = listed is not None and one.id not in listed
        reason = wrong or broken or ("in no split file" if unlisted else config.length_problem(clip.seconds))
        keep = config.uncaptioned == "keep"
        wanted = config.has_captions
        draft.add(clip, reason, captioned=bool(texts), wanted=wanted, keep=keep)
    settle_index(config, draft, apart)
