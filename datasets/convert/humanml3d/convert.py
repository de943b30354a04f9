"""HumanML3D -> shards: the published 263-column vectors as they are, or features made from the joints.

Choices:
- The published folders hold the same motion twice: new_joints/ is new_joint_vecs/ decoded (both have one
  frame less than the motion had). So either can stand for the other, and where both are read they are
  compared.
- Layout `h3d263` at 20 fps keeps the vectors bit for bit. Made again from new_joints/ they are not the same:
  one more frame is lost, and the published code starts every clip with a forced heading that decoding has
  already turned into motion (docs/sources.md says how much). That way keeps each clip's own bone lengths,
  which are HumanML3D's uniform ones.
- Segment captions stay captions with start and end; what trains on them cuts the frames or the tokens. A
  mirrored clip `M<id>` names its original and stays in the split of its original.

A plan reads headers and captions, no motion. Every clip is accounted for: to convert, left out, broken or
missing; and so are caption lines that are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import features_of, frames_after, require_human
from motionloom.datasets.convert.common.files import check_id, inside, read_in_threads
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan, drop
from motionloom.datasets.convert.common.splits import (
    SplitNames,
    hash_splits,
    keep_mirrors_together,
    original_of,
    read_split_files,
)
from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption, Dropped, Split, UserError
from motionloom.datasets.shards.sample import Sample

FPS = 20.0
VECS, JOINTS = "new_joint_vecs", "new_joints"
WIDTHS: dict[str, int | tuple[int, ...]] = {VECS: 263, JOINTS: (22, 3)}
LICENCE = (
    "HumanML3D: motion derived from AMASS (non-commercial research only, no redistribution) and HumanAct12; "
    "captions MIT"
)

AGREEMENT = 0.01
"""Metres by which new_joints/ may differ from decoded new_joint_vecs/; the published pairs agree to 1e-6."""


class HumanMl3dConfig(ConvertConfig):
    """Options of the HumanML3D converter; `source` is the folder HumanML3D/ of the release."""

    layouts = ("h3d263", "body133")

    name: str = "humanml3d"
    """Name of the data set; part of the shards' file names."""
    layout: str = "h3d263"
    """`h3d263` keeps the published vectors; `body133` is made from the joints."""
    fps: float = Field(default=FPS, gt=0, le=240)
    """Frame rate of the shards. At any other than 20 the published vectors are made again from the joints."""
    use: Literal["auto", "vecs", "joints"] = "auto"
    """`vecs` reads new_joint_vecs/ only, `joints` new_joints/ only. `auto` takes what the layout needs least
    work for, and where both are there, leaves out clips for which they differ."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton (published vectors are then made again)."""
    uncaptioned: Literal["drop", "keep"] = "drop"
    """What to do with clips that have no usable caption."""

    @property
    def keeps_vectors(self) -> bool:
        """Whether the published vectors become the shards' features as they are, where they are read."""
        return self.layout == "h3d263" and self.fps == FPS and not self.retarget

    @property
    def folders(self) -> tuple[str, ...]:
        if self.use != "auto":
            return (VECS,) if self.use == "vecs" else (JOINTS,)
        return (VECS, JOINTS) if self.keeps_vectors else (JOINTS, VECS)


@dataclass(frozen=True)
class HumanMl3dClip:
    """A clip of the plan."""

    id: str
    split: Split
    files: tuple[str, ...]
    """Motion files by their names in the source: the one to use, then the one to compare with, if any."""
    frames: int
    """Frames in the files, at 20 a second."""
    texts: tuple[Caption, ...]
    licence: str

    @property
    def facts(self) -> dict[str, float]:
        mirrored = original_of(self.id) is not None
        return {"seconds": self.frames / FPS, "captions": len(self.texts), "mirrored": float(mirrored)}

    def label(self) -> str:
        return self.files[0]


@dataclass(frozen=True)
class _Scanned:
    files: tuple[str, ...]
    frames: int = 0
    texts: tuple[Caption, ...] = ()
    broken: tuple[Dropped, ...] = ()
    problems: tuple[str, ...] = ()


class HumanMl3d(Converter[HumanMl3dConfig, HumanMl3dClip]):
    """The HumanML3D converter."""

    name = "humanml3d"
    title = "HumanML3D"
    summary = "HumanML3D: new_joints or new_joint_vecs, texts and split files to shards."
    example = "HumanML3D shards"
    config_class = HumanMl3dConfig

    def plan(self, settings: PlanSettings) -> ConversionPlan[HumanMl3dClip]:
        return plan_humanml3d(self.config, settings)

    def depends_on(self, clip: HumanMl3dClip) -> list[object]:
        sizes = [(self.config.source / file).stat().st_size for file in clip.files]
        return [clip.id, clip.files, sizes, [caption.dump() for caption in clip.texts]]

    def joints(self, clip: HumanMl3dClip) -> SourceJoints:
        return SourceJoints(_joints(_load(self.config, clip, clip.files[0])), FPS)

    def convert(self, clip: HumanMl3dClip) -> Sample:
        config, layout = self.config, self.layout
        stored = [_load(config, clip, file) for file in clip.files]
        joints = _joints(stored[0])
        require_human(joints, FPS)
        if len(stored) > 1:
            _require_same(joints, _joints(stored[1]), clip)
        if config.keeps_vectors and stored[0].ndim == 2:
            motion = stored[0].astype(np.float32, copy=False)
        elif layout.family == "exact":
            motion = features_of(joints, FPS, layout, same_bones=config.retarget)
        else:
            bones = None if config.retarget else layout.skeleton.bones(joints[0])
            motion = encode_h3d(resample(joints, FPS, layout.fps), layout, bones)
        meta = self.meta(clip, motion, licence=clip.licence, mirror_of=original_of(clip.id))
        return Sample(meta=meta, motion=motion, texts=list(clip.texts))


def _load(
    config: HumanMl3dConfig, clip: HumanMl3dClip, file: str
) -> NDArray[np.float32] | NDArray[np.float64]:
    folder, name = file.split("/", 1)
    path = inside(config.source / folder, name, file)
    values = load_array(path, width=WIDTHS[folder], name=file)
    if len(values) != clip.frames:
        raise UserError(f"{file}: {len(values)} frames, {clip.frames} when the plan was made; convert again")
    return values


def _joints(stored: NDArray[np.float32] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Joints [T, 22, 3] of either file: stored [T, 22, 3], or vectors [T, 263] to decode."""
    if stored.ndim == 2:
        return decode(stored, MotionLayout.named("h3d263"))
    return stored.astype(np.float64)


def _require_same(joints: NDArray[np.float64], others: NDArray[np.float64], clip: HumanMl3dClip) -> None:
    away = np.linalg.norm(joints - others, axis=-1).max(axis=-1)
    if not away.max() <= AGREEMENT:
        raise UserError(
            f"{clip.label()}: differs from {clip.files[1]} by {away.max():.3g} m at frame "
            f"{int(away.argmax())}; choose one with --set use=vecs or --set use=joints"
        )


def plan_humanml3d(config: HumanMl3dConfig, settings: PlanSettings) -> ConversionPlan[HumanMl3dClip]:
    """Find every clip and decide what becomes of it, without converting anything."""
    layout = config.motion_layout()
    if not config.source.is_dir():
        raise UserError(f"{config.source}: no such folder")
    present, strange = _list_motion(config)
    folder, texts = _list_texts(config)
    splits, notes = _read_splits(config, sorted(present))
    ids = sorted(present)
    scan = partial(_scan, config, folder, texts, present)
    found_here = read_in_threads(scan, ids, workers=settings.workers, progress=settings.progress)
    scanned = dict(zip(ids, found_here, strict=True))

    licence = config.licence or LICENCE
    draft = ConversionPlan[HumanMl3dClip](config, broken=strange, notes=notes)
    whole = {clip_id: found for clip_id, found in scanned.items() if found.frames}
    for clip_id, found in whole.items():
        split = splits.get(clip_id)
        if split is None:
            reason = "in no split file"
        elif not found.texts and config.uncaptioned == "drop":
            reason = "no usable caption"
        else:
            reason = config.licence_problem(licence) or config.length_problem(found.frames / FPS)
        if split is None or reason:
            draft.leave_out(found.files[0], reason)
            continue
        draft.take(HumanMl3dClip(clip_id, split, found.files, found.frames, found.texts, licence))
    draft.broken += [problem for found in scanned.values() for problem in found.broken]
    draft.uncaptioned += [found.files[0] for found in whole.values() if not found.texts]
    draft.notes += [problem for found in scanned.values() for problem in found.problems]
    strays = len(texts.keys() - present.keys())
    if strays:
        draft.notes.append(f"{strays} caption files in {folder}/ belong to no motion file here")
    draft.limit(HumanMl3dClip.label)

    wanted = "/ or ".join(config.folders)
    for clip_id, split in splits.items():
        if clip_id not in present:
            draft.miss(clip_id, f"listed in {split}.txt, but not in {wanted}/")
    return draft.finish(
        found=len(present),
        frames=lambda clip: (
            clip.frames  # vectors that are kept lose none
            if config.keeps_vectors and clip.files[0].startswith(VECS)
            else frames_after(clip.frames, FPS, layout)
        ),
        licence=lambda clip: clip.licence,
    )


def _list_motion(config: HumanMl3dConfig) -> tuple[dict[str, tuple[str, ...]], list[Dropped]]:
    """Clip id -> its motion files, the preferred first; and files whose names cannot be ids."""
    found: dict[str, list[str]] = {}
    strange: list[Dropped] = []
    folders = [folder for folder in config.folders if (config.source / folder).is_dir()]
    if not folders:
        wanted = "/ or ".join(config.folders)
        raise UserError(f"{config.source}: no {wanted}/ in it; give the folder HumanML3D/ of the release")
    for folder in folders:
        for name in sorted(path.name for path in (config.source / folder).iterdir()):
            if not name.endswith(".npy") or name.startswith("."):
                continue
            label = f"{folder}/{name}"
            try:
                found.setdefault(check_id(name.removesuffix(".npy"), label), []).append(label)
            except UserError as error:
                strange.append(drop(label, error))
    return {clip_id: tuple(files) for clip_id, files in found.items()}, strange


def _list_texts(config: HumanMl3dConfig) -> tuple[str, dict[str, str]]:
    """The folder of the caption files in the source (empty without one), and clip id -> file name."""
    for folder in ("texts/texts", "texts"):
        if (config.source / folder).is_dir():
            names = [path.name for path in (config.source / folder).iterdir()]
            texts = [name for name in names if name.endswith(".txt") and not name.startswith(".")]
            return folder, {name.removesuffix(".txt"): name for name in texts}
    if config.uncaptioned == "keep":
        return "", {}
    hint = "unpack texts.zip" if (config.source / "texts.zip").exists() else "clips would have no captions"
    raise UserError(f"{config.source}: no texts/ in it; {hint} (or --set uncaptioned=keep)")


def _read_splits(config: HumanMl3dConfig, ids: list[str]) -> tuple[dict[str, Split], list[str]]:
    if not SplitNames().files(config.source):
        return hash_splits(ids)
    splits, notes = read_split_files(config.source)
    keep_mirrors_together(splits, config.source)
    return splits, notes


def _scan(
    config: HumanMl3dConfig,
    text_folder: str,
    texts: dict[str, str],
    present: dict[str, tuple[str, ...]],
    clip_id: str,
) -> _Scanned:
    found = _Scanned(present[clip_id])
    lengths = {}
    for label in found.files:
        folder = label.split("/", 1)[0]
        try:
            path = inside(config.source / folder, f"{clip_id}.npy", label)
            lengths[label] = check_array_header(path, width=WIDTHS[folder], name=label)
        except UserError as error:
            return replace(found, broken=(drop(label, error),))
    if len(set(lengths.values())) > 1:
        lengths_found = ", ".join(f"{label} {frames}" for label, frames in lengths.items())
        reason = f"frames differ ({lengths_found}); choose one with --set use=vecs or --set use=joints"
        return replace(found, broken=(Dropped(source=found.files[0], reason=reason),))
    found = replace(found, frames=lengths[found.files[0]])
    if clip_id not in texts:
        return found
    label = f"{text_folder}/{texts[clip_id]}"
    try:
        path = inside(config.source / text_folder, texts[clip_id], label)
        captions, problems = read_humanml_captions(path, seconds=found.frames / FPS, name=label)
    except UserError as error:
        return replace(found, broken=(drop(label, error),))
    joined = "; ".join(problems)
    return replace(found, texts=tuple(captions), problems=(f"{label}: {joined}",) if problems else ())
