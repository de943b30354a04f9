"""HumanML3D: the published 263-column vectors as they are, or features made from the joints.

The published folders hold the same motion twice: new_joints/ is new_joint_vecs/ decoded (both have one frame
less than the motion had). So either can stand for the other.

Layout `h3d263` at 20 fps keeps the vectors bit for bit. Made again from new_joints/ they are not the same:
one more frame is lost, and the published code starts every clip with a forced heading, which decoding has
turned into motion (docs/sources.md says how much). That way keeps each clip's own bone lengths, which are
HumanML3D's uniform ones.

Segment captions stay captions with start and end; what trains on them cuts the frames or the tokens. A
mirrored clip `M<id>` names its original and stays in the split of its original.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.datasets.base.memory import content_of
from motionloom.datasets.base.records import Caption
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.features import features_of, require_human
from motionloom.datasets.convert.common.files import check_id, files_in, inside
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, Release, ReleaseClip, ReleaseConfig
from motionloom.datasets.convert.common.splits import original_of
from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import Sample

FPS = 20.0
VECS = "new_joint_vecs"
JOINTS = "new_joints"
SAME_METRES, _COMPARED = 0.01, 20
"""Distance of joints of the two copies of a motion, at most, in so many frames: 4e-8 was measured."""
WIDTHS: dict[str, int | tuple[int, ...]] = {VECS: 263, JOINTS: (22, 3)}


class HumanMl3dConfig(ReleaseConfig):
    """Options of the HumanML3D converter; `source` is the folder HumanML3D/ of the release."""

    layouts = ("h3d263", "body133")

    name: str = "humanml3d"
    layout: str = "h3d263"
    """`h3d263` keeps the published vectors; `body133` is made from the joints."""
    fps: float = Field(default=FPS, gt=0, le=240)
    """Frame rate of the shards. At any other than 20 the published vectors are made again from the joints."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton (published vectors are then made again)."""
    uncaptioned: Literal["drop", "keep"] = "drop"

    @property
    def keeps_vectors(self) -> bool:
        """Whether the published vectors become the shards' features as they are, where they are read."""
        return self.layout == "h3d263" and self.fps == FPS and not self.retarget

    @property
    def folders(self) -> tuple[str, ...]:
        """Folders of motion, the one that the layout needs less work for first."""
        return (VECS, JOINTS) if self.keeps_vectors else (JOINTS, VECS)


class HumanMl3d(Release[HumanMl3dConfig]):
    """The HumanML3D converter."""

    name = "humanml3d"
    title = "HumanML3D"
    summary = "HumanML3D: new_joints or new_joint_vecs, texts and split files to shards."
    example = "HumanML3D shards"
    config_class = HumanMl3dConfig
    terms = (
        "HumanML3D: motion derived from AMASS (non-commercial research only, no redistribution) and "
        "HumanAct12; captions MIT"
    )
    lists = ("",)

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        files = self._motion(draft)
        folder = self._texts()
        texts_here = files_in(self.config.source / folder, ".txt") if folder else []
        listed = {name.removesuffix(".txt") for name in texts_here}
        if folder and (strays := len(listed - files.keys())):
            draft.notes.append(f"{strays} caption files in {folder}/ belong to no motion file here")
        for clip_id, file in sorted(files.items()):
            texts: list[Caption] = []
            if folder and clip_id in listed:
                label = f"{folder}/{clip_id}.txt"
                with draft.reading(label):
                    path = inside(self.config.source / folder, f"{clip_id}.txt", label)
                    texts, problems = read_humanml_captions(path, seconds=None, name=label)
                    draft.notes += [f"{label}: {'; '.join(problems)}"] if problems else []
            original = original_of(clip_id)
            yield Entry(
                clip_id, file, tuple(texts), group=original or clip_id, mirror_of=original,
                facts={"mirrored": float(original is not None)},
            )  # fmt: skip

    def _motion(self, draft: ConversionPlan[ReleaseClip]) -> dict[str, str]:
        """Clip id -> its preferred motion file."""
        source = self.config.source
        wanted = self.config.folders
        if not any((source / folder).is_dir() for folder in wanted):
            raise UserError(
                f"{source}: no {'/ or '.join(wanted)}/ in it; give the folder HumanML3D/ of the release"
            )
        found: dict[str, str] = {}
        for folder in wanted:
            for name in files_in(source / folder, ".npy") if (source / folder).is_dir() else ():
                label = f"{folder}/{name}"
                with draft.reading(label):
                    found.setdefault(check_id(name.removesuffix(".npy"), label), label)
        return found

    def _texts(self) -> str:
        """The folder of the caption files in the source; empty where there is none and none is needed."""
        source = self.config.source
        for folder in ("texts/texts", "texts"):
            if (source / folder).is_dir():
                return folder
        if self.config.uncaptioned == "keep":
            return ""
        hint = "unpack texts.zip" if (source / "texts.zip").exists() else "clips would have no captions"
        raise UserError(f"{source}: no texts/ in it; {hint} (or --set uncaptioned=keep)")

    def path_of(self, file: str) -> Path:
        """A file of the set, whose folder may be a link: people keep parts of a release on several disks."""
        folder, name = file.split("/", 1)
        return inside(self.config.source / folder, name, file)

    def length(self, path: Path, label: str) -> tuple[int, float]:
        frames = _frames(path, label)
        other = _other(label)
        if is_file(self.path_of(other)) and (there := _frames(self.path_of(other), other)) != frames:
            raise UserError(
                f"{label}: {frames} frames, but {other}, which holds the same motion, has {there}"
            )
        return frames, FPS

    def frames(self, clip: ReleaseClip) -> int:
        kept = self.config.keeps_vectors and clip.entry.file.startswith(VECS)
        return clip.last if kept else super().frames(clip)

    def figure(self, clip: ReleaseClip) -> Figure:
        return Figure(joints=_joints(self._load(clip.entry.file)))

    def convert(self, clip: ReleaseClip) -> Sample:
        config = self.config
        layout = self.layout
        stored = self._load(clip.entry.file)
        joints = _joints(stored)
        require_human(joints, FPS)
        if config.keeps_vectors and stored.ndim == 2:
            motion = stored.astype(np.float32, copy=False)
        elif layout.family == "exact":
            motion = features_of(joints, FPS, layout, same_bones=config.retarget)
        else:
            bones = None if config.retarget else layout.skeleton.bones(joints[0])
            motion = encode_h3d(resample(joints, FPS, layout.fps), layout, bones)
        return Sample(self.clip_meta(clip, motion, joints), motion, texts=list(clip.entry.texts))

    def depends_on(self, clip: ReleaseClip) -> list[object]:
        other = self.path_of(_other(clip.entry.file))
        return [*super().depends_on(clip), content_of(other) if is_file(other) else ""]

    def _load(self, file: str) -> NDArray[np.floating]:
        """A motion file; `UserError` where the release's other copy of it shows another motion."""
        stored = _load(self.path_of(file), file)
        other = _other(file)
        if is_file(self.path_of(other)):
            beside = _load(self.path_of(other), other)
            apart = np.abs(_joints(stored[:_COMPARED]) - _joints(beside[:_COMPARED])).max()
            if not apart < SAME_METRES:
                raise UserError(
                    f"{file}: {other} shows another motion ({apart:.2f} m apart), and nothing says which of "
                    f"them the captions are about"
                )
        return stored


def _other(file: str) -> str:
    """The file with the release's other copy of a motion."""
    folder, name = file.split("/", 1)
    return f"{JOINTS if folder == VECS else VECS}/{name}"


def _frames(path: Path, label: str) -> int:
    return check_array_header(path, width=WIDTHS[label.split("/", 1)[0]], name=label)


def _load(path: Path, label: str) -> NDArray[np.floating]:
    return load_array(path, width=WIDTHS[label.split("/", 1)[0]], name=label)


def _joints(stored: NDArray[np.floating]) -> NDArray[np.float64]:
    """Joints [T, 22, 3] of either file: stored [T, 22, 3], or vectors [T, 263] to decode."""
    if stored.ndim == 2:
        return decode(stored, MotionLayout.named("h3d263"))
    return stored.astype(np.float64)


register(HumanMl3d)
