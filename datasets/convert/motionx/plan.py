"""Motion-X conversion, planning: options, and a plan of what becomes of every file of the source.

Headers and texts are read; motion data is not, except a few `aist/` clips whose scale is examined. Only the
motion is required: splits, captions, face motion and face texts are taken where they are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.files import read_in_threads
from motionloom.datasets.convert.common.plan import ConversionPlan, drop
from motionloom.datasets.convert.common.splits import (
    SplitNames,
    hash_splits,
    keep_mirrors_together,
    read_split_files,
)
from motionloom.datasets.convert.motionx.files import (
    HUMANML,
    SOURCE,
    Kind,
    MotionXFiles,
    find_files,
    official_id,
    read_sentences,
    subset_of,
)
from motionloom.datasets.convert.motionx.parameters import FACE_WIDTH, RAW, aist_scale
from motionloom.datasets.motion.body.smpl import SkeletonName
from motionloom.datasets.schema import Caption, Dropped, Split, UserError

FPS = 30.0
AIST = "aist"
MOCAP = ("humanml", "EgoBody", "GRAB")
"""Subsets whose faces come in files of their own."""

LICENCE = "Motion-X-noncommercial"
LICENCES = {
    "humanml": "AMASS-noncommercial",
    "GRAB": "GRAB-noncommercial",
    "EgoBody": "EgoBody-noncommercial",
    "aist": "Motion-X-noncommercial AND AIST++-annotations-CC-BY-4.0",
    "HAA500": "Motion-X-noncommercial AND HAA500-terms",
    "humman": "Motion-X-noncommercial AND HuMMan-terms",
}
"""Our reading, on the careful side: motion that the user gets from its own site keeps that site's licence,
all that Motion-X hands out needs its agreement as well, and both count where it has a first owner."""

_SPLIT_FOLDERS = ("", "split", "splits", "datasets")
_LOOKED_AT = 8
"""Clips of `aist/` that the plan reads to tell their scale."""


class MotionXConfig(ConvertConfig):
    """Options of the Motion-X converter. `source` is the folder that holds motion_data/ and texts/, under
    any of the names they have had."""

    layouts = ("wholebody363", "wholebody313", "body133", "tomato623", "h3d263", "smplx322")

    name: str = "motionx"
    layout: str = "wholebody363"
    fps: float = FPS
    subsets: tuple[str, ...] = ()
    """Convert only these subsets (`GRAB`, `idea400`, ...); empty means all."""
    splits: Path | None = None
    """Folder of train.txt, val.txt, test.txt; else searched at the top of the source, in `split/`, `splits/`
    and `datasets/`; else 80/5/15 by hash of the id."""
    body_model: Path | None = None
    """Your SMPL-X or SMPL-H model (.npz), for joints with each clip's own shape; else a neutral skeleton."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton (the h3d layouts always do)."""
    up: Literal["y", "z"] = "y"
    """Up axis of the source. The release is Y up; `z` is for own files that no script has turned yet."""
    uncaptioned: Literal["drop", "keep"] = "drop"
    """What to do with clips that have no usable caption."""
    frame_texts: bool = False
    """Add the sentences about single frames (body_texts, hand_texts) as captions of 1/30 s and longer, with
    source `body` and `hand`. They are many: about one a frame."""

    @property
    def skeleton(self) -> SkeletonName:
        return "smpl22" if self.motion_layout().skeleton_name == "smpl22" else "smplx52"


@dataclass(frozen=True)
class MotionXClip:
    """A clip of the plan. Paths are relative to the source."""

    id: str
    path: str
    split: Split
    frames: int
    """At 30 a second."""
    licence: str
    texts: tuple[Caption, ...] = ()
    face_texts: tuple[Caption, ...] = ()
    face: str | None = None
    """Face motion to write in."""
    frame_texts: tuple[tuple[str, str], ...] = ()
    """(source of the captions, file) of sentences about frames."""

    @property
    def facts(self) -> dict[str, str | float]:
        captions = len(self.texts) + len(self.face_texts)
        return {"subset": self.subset, "seconds": self.frames / FPS, "captions": float(captions)}

    @property
    def subset(self) -> str:
        return subset_of(self.id)

    @property
    def files(self) -> tuple[str, ...]:
        """Every file the sample is made of, but for texts."""
        return (self.path, *([self.face] if self.face else []), *(file for _, file in self.frame_texts))

    def label(self) -> str:
        return self.path


@dataclass(frozen=True)
class _Scanned:
    id: str
    frames: int = 0
    texts: tuple[Caption, ...] = ()
    face_texts: tuple[Caption, ...] = ()
    face: str | None = None
    broken: tuple[Dropped, ...] = ()
    problems: tuple[str, ...] = ()


def plan_motionx(config: MotionXConfig, settings: PlanSettings) -> ConversionPlan[MotionXClip]:
    """Find every clip and decide what becomes of it, without converting anything."""
    layout = config.motion_layout()
    files = find_files(config.source)
    motion = files.by_kind["motion"]
    ids = sorted(clip_id for clip_id in motion if _wanted(config, clip_id))
    if not ids:
        present = sorted({subset_of(clip_id) for clip_id in motion})
        raise UserError(f"{config.source}: none of {config.subsets} in it, but {', '.join(present)}")
    splits, notes = _read_splits(config, files, ids)
    scan = partial(_scan, config.source, files)
    scanned = list(read_in_threads(scan, ids, workers=settings.workers, progress=settings.progress))

    broken = [*files.broken, *(problem for found in scanned for problem in found.broken)]
    draft = ConversionPlan[MotionXClip](
        config, dropped=list(files.repeated), broken=broken, notes=[*files.notes(), *notes]
    )
    for found in scanned:
        if not found.frames:
            continue  # broken
        path, split = motion[found.id], splits.get(found.id)
        licence = config.licence or LICENCES.get(subset_of(found.id), LICENCE)
        if not found.texts:
            draft.uncaptioned.append(path)
        if split is None:
            reason = "in no split file"
        elif not found.texts and config.uncaptioned == "drop":
            reason = "no usable caption"
        else:
            reason = config.length_problem(found.frames / FPS) or config.licence_problem(licence)
        if reason or split is None:
            draft.leave_out(path, reason)
            continue
        frame_texts = _frame_texts(files, found.id) if config.frame_texts else ()
        draft.take(
            MotionXClip(
                found.id, path, split, found.frames, licence, found.texts, found.face_texts, found.face,
                frame_texts,
            )
        )  # fmt: skip
    draft.limit(MotionXClip.label)
    unwanted = len(motion) - len(ids)
    texts_alone = [clip_id for clip_id in files.by_kind["captions"] if clip_id not in motion]
    for clip_id, split in splits.items():
        if clip_id not in motion:
            draft.miss(clip_id, f"listed in {split}.txt, but its motion is not here")
    draft.notes += [
        *_subset_notes(config, files, scanned),
        *([f"{unwanted} clips of other subsets are not asked for"] if unwanted else []),
        *([f"{len(texts_alone)} caption files have no motion"] if texts_alone else []),
        *(problem for found in scanned for problem in found.problems),
    ]
    return draft.finish(
        found=len(ids) + len(files.repeated),
        frames=lambda clip: frames_after(clip.frames, FPS, layout),
        licence=lambda clip: clip.licence,
    )


def _wanted(config: MotionXConfig, clip_id: str) -> bool:
    return not config.subsets or subset_of(clip_id) in config.subsets


def _read_splits(
    config: MotionXConfig, files: MotionXFiles, ids: list[str]
) -> tuple[dict[str, Split], list[str]]:
    """Split of every wanted id, and notes."""
    names = SplitNames()
    if config.splits is not None:
        folder: Path | None = config.splits
        origin = "splits: from the folder given"
    else:
        found = [name for name in _SPLIT_FOLDERS if names.files(config.source / name)]
        folder = config.source / found[0] if found else None
        origin = f"splits: {found[0] or '.'}/" if found else ""
    if folder is None:
        return hash_splits(ids)
    listed, notes = read_split_files(folder)
    keep_mirrors_together(listed, folder)
    splits: dict[str, Split] = {}
    for clip_id, split in listed.items():
        official = official_id(clip_id.removesuffix(".npy"))
        if splits.setdefault(official, split) != split:
            raise UserError(
                f"{folder}: '{official}' is in {splits[official]}.txt and {split}.txt; that leaks"
            )
    wanted = {clip_id: split for clip_id, split in splits.items() if _wanted(config, clip_id)}
    return wanted, [*([origin] if origin else []), *notes]


def _scan(source: Path, files: MotionXFiles, clip_id: str) -> _Scanned:
    label = files.by_kind["motion"][clip_id]
    broken: list[Dropped] = []
    problems: list[str] = []
    try:
        frames = check_array_header(source / label, width=RAW.dim, name=label)
    except UserError as error:
        return _Scanned(clip_id, broken=(drop(label, error),))

    def sentences(kind: Kind, read: Callable[[Path, str], tuple[list[Caption], list[str]]]) -> list[Caption]:
        file = files.by_kind[kind].get(clip_id)
        if file is None:
            return []
        try:
            texts, wrong = read(source / file, file)
        except UserError as error:
            broken.append(drop(file, error))
            return []
        problems.extend([f"{file}: {'; '.join(wrong)}"] if wrong else [])
        return texts

    read: Callable[..., tuple[list[Caption], list[str]]] = read_sentences
    if subset_of(clip_id) == HUMANML:
        read = partial(read_humanml_captions, seconds=frames / FPS)
    texts = sentences("captions", lambda path, name: read(path, source=SOURCE, name=name))
    face_texts = sentences("face texts", lambda path, name: read_sentences(path, source="face", name=name))
    face = files.by_kind["face motion"].get(clip_id)
    if face is not None:
        try:
            check_array_header(source / face, width=FACE_WIDTH, name=face)
        except UserError as error:
            broken.append(drop(face, error))
            face = None
    return _Scanned(clip_id, frames, tuple(texts), tuple(face_texts), face, tuple(broken), tuple(problems))


def _frame_texts(files: MotionXFiles, clip_id: str) -> tuple[tuple[str, str], ...]:
    found = (("body", files.by_kind["body texts"]), ("hand", files.by_kind["hand texts"]))
    return tuple((source, table[clip_id]) for source, table in found if clip_id in table)


def _subset_notes(config: MotionXConfig, files: MotionXFiles, scanned: list[_Scanned]) -> list[str]:
    notes = []
    humanml = [found for found in scanned if subset_of(found.id) == HUMANML]
    if humanml and not any(found.texts for found in humanml):
        notes.append("humanml/ has no captions: unpack HumanML3D's texts.zip as humanml/ beside the others")
    mocap = [found for found in scanned if subset_of(found.id) in MOCAP and found.frames]
    faceless = sum(found.face is None for found in mocap)
    if faceless:
        notes.append(
            f"{faceless} of {len(mocap)} clips of {', '.join(MOCAP)} have no face motion file: unless their "
            f"own columns hold an expression, their face is masked"
        )
    dances = [found.id for found in scanned if subset_of(found.id) == AIST and found.frames]
    states: Counter[str] = Counter()
    for clip_id in sorted(dances, key=sha256_of_json)[:_LOOKED_AT]:
        path = files.by_kind["motion"][clip_id]
        try:
            states[aist_scale(load_array(config.source / path, width=RAW.dim, name=path))] += 1
        except UserError:
            states["broken"] += 1  # the conversion reports why
    if states:
        counts = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
        notes.append(
            f"aist/: of {states.total()} clips looked at, {counts}; raw ones are brought to metres once "
            f"(/ 94, z negated), each judged by itself"
        )
    return notes
