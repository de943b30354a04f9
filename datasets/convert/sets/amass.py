"""AMASS (SMPL-H or SMPL-X .npz) -> shards: parameters to joints without the mesh, joints to features.

Z up becomes Y up. Jaw, eyes, soft tissue (`dmpls`) and markers are not used. `smpl75` keeps the parameters,
without a shape; its two hand joints are SMPL's, at rest for SMPL-H and SMPL-X, which have none. A plan opens
files that may be used, but only for their headers and a few scalars.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.captions.humanml_index import (
    INDEX_FPS,
    HumanmlConfig,
    IndexRow,
    clip_key,
    index_clips,
    read_index,
    thinning,
)
from motionloom.datasets.convert.captions.options import Listing, settle_captions
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import (
    canonical_smpl75,
    features_of,
    mirrored,
    require_human,
    upright,
)
from motionloom.datasets.convert.common.files import check_id, walk_files
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, Release, ReleaseClip, ReleaseConfig
from motionloom.datasets.convert.common.tables import BadRows
from motionloom.datasets.convert.smpl.body import FINGERS_MOVE
from motionloom.datasets.convert.smpl.smpl_npz import MotionHeader, RateError, read_motion, read_motion_header
from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.shards.sample import Sample

SUFFIX = ".npz"
LICENCE = "AMASS-noncommercial"
"""Stated for every subset. The motions come from many laboratories with terms of their own, some of them
freer, but the fits are AMASS's: non-commercial research only, and not to be passed on.
"""
_MODEL_OPTIONS = {"neutral": "body_model", "female": "body_model_female", "male": "body_model_male"}


class AmassConfig(HumanmlConfig, ReleaseConfig):
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
    up: Literal["z", "y"] = "z"
    """The axis that points up in the files; AMASS's is z."""
    source_fps: float | None = Field(default=None, ge=1, le=10_000)
    """Overrides the files' frame rate, for collections that state a wrong one or none."""


class Amass(Release[AmassConfig]):
    """The AMASS converter."""

    name = "amass"
    title = "AMASS"
    summary = "AMASS: SMPL-H and SMPL-X .npz files to shards."
    example = "AMASS shards"
    config_class = AmassConfig
    beside = ("shape.npz", "_stagei.npz")
    terms = LICENCE

    def __init__(self, config: AmassConfig) -> None:
        super().__init__(config)
        skeleton = cast("SkeletonName", self.layout.skeleton_name)
        paths = {gender: getattr(config, option) for gender, option in _MODEL_OPTIONS.items()}
        bodies = {
            gender: BodyModel.load(path, skeleton) for gender, path in paths.items() if path is not None
        }
        self.kinds = {gender: str(body.statement["kind"]) for gender, body in bodies.items()}
        """Kind of the user's body models by gender; empty without any."""
        self.bodies = bodies or {"neutral": BodyModel.neutral(skeleton)}
        """By gender; `neutral` serves the genders that are not there."""
        self.headers: dict[str, MotionHeader] = {}
        self.rows: dict[str, IndexRow] = {}
        """Rows of the index by clip id, of mirrored clips too."""
        self.listing: Listing | None = None

    def plan(self, settings: PlanSettings) -> ConversionPlan[ReleaseClip]:
        plan = super().plan(settings)
        plan.notes.extend(sorted({str(body.statement["sentence"]) for body in self.bodies.values()}))
        if self.listing is not None:
            settle_captions(self.config, plan, self.listing)
        return plan

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterator[Entry]:
        labels = list_files(self.config.source, draft)
        draft.totals.found = len(labels)
        if self.config.humanml_index is not None:
            yield from self._index_entries(self.config.humanml_index, labels, draft)
            return
        listing = self.listing = self.config.listing(labels)
        draft.notes += listing.notes
        first: dict[str, str] = {}
        for label in labels:
            same = first.setdefault(clip_key(label), label)
            again = "" if same == label else f"the same recording as {same}"
            yield Entry(
                listing.id_of(label), label, listing.texts_of(label), listing.split_of(label),
                problem=listing.problem(label) or again,
            )  # fmt: skip

    def _index_entries(
        self, index: Path, labels: list[str], draft: ConversionPlan[ReleaseClip]
    ) -> Iterator[Entry]:
        """Every row of the index as one clip, or two with `mirror`; files without a row are reported."""
        by_key: dict[str, str] = {}
        for label in labels:
            first = by_key.setdefault(clip_key(label), label)
            if first is not label:
                draft.skip(label, f"the same clip as {first}")
        bad: BadRows = {}
        found = [(row, by_key.get(clip_key(row.source))) for row in read_index(index, bad)]
        draft.mark_rows_unreadable(bad)
        for one in index_clips(self.config, found, self.listed):
            self.rows[one.id] = one.row
            yield Entry(one.id, one.file or one.row.source, split=one.split, mirror_of=one.mirror_of)
        used = {file for _, file in found}
        for label in by_key.values():
            if label not in used:
                draft.skip(label, "in no row of the index")

    def split_lists(self, draft: ConversionPlan[ReleaseClip]) -> dict[str, Split] | None:
        """Return the splits of the index's clips; those of whole files go with the captions."""
        if self.config.humanml_index is None:
            return None
        listed, notes = self.config.index_splits()
        draft.notes += notes
        return listed

    def length(self, path: Path, label: str) -> tuple[int, float]:
        try:
            header = self.headers[label] = read_motion_header(path, label, self.config.source_fps)
        except RateError as error:
            raise UserError(f"{error}; state it: --set source_fps=120") from None
        if not header.fps:
            raise UserError("no mocap_framerate and no mocap_frame_rate in it; set source_fps")
        return header.frames, header.fps

    def fitted(self, entry: Entry, frames: int, fps: float, draft: ConversionPlan[ReleaseClip]) -> Entry:
        header = self.headers[entry.file]
        parts = PurePosixPath(entry.file).parts
        subset = parts[-3] if len(parts) > 2 else "."
        entry = replace(
            entry,
            facts={"subset": subset, "gender": header.gender, "model": header.kind, "fps": fps},
            problem=entry.problem or self._body_problem(header),
        )
        if (row := self.rows.get(entry.id)) is None:
            return entry
        first, last = row.cut(header.frames, fps)
        beyond = "" if last > first else f"the index cuts beyond the {header.frames} frames of the file"
        texts, broken = self._index_texts(entry.id, fps, draft)
        problem = beyond or broken or entry.problem
        return replace(entry, texts=texts, first=first, last=last, problem=problem)

    def _index_texts(
        self, clip_id: str, fps: float, draft: ConversionPlan[ReleaseClip]
    ) -> tuple[tuple[Caption, ...], str]:
        """Captions of a clip of the index, in its own seconds, and why it must be left out."""
        captions, broken = self.config.index_texts(clip_id, None, draft.notes)
        # The texts count seconds as frames / 20; a file thinned to 20.83 frames a second is a little shorter.
        scale = INDEX_FPS * thinning(fps) / fps
        if abs(scale - 1.0) > 1e-6:
            captions = tuple(
                caption.model_copy(
                    update={"start": caption.start * scale, "end": caption.end and caption.end * scale}
                )
                for caption in captions
            )
        return captions, broken

    def _body_problem(self, header: MotionHeader) -> str:
        """Return the reason that parameters do not fit layout or body models; empty when they do."""
        if self.layout.num_joints > BODY_JOINTS and not header.hands:
            return f"{header.kind} without finger rotations; layout {self.config.layout} has fingers"
        if not self.kinds:
            return ""
        kind = self.kinds.get(header.gender) or self.kinds.get("neutral")
        if kind is None:
            return f"no body model for gender '{header.gender}'; set body_model, which serves all"
        if (kind == "SMPL-X") != (header.kind == "SMPL-X"):
            return (
                f"{header.kind} parameters, but the body model is {kind}: their shapes and rest poses differ"
            )
        return ""

    def options(self) -> dict[str, object]:
        return super().options() | {
            "bodies": {gender: body.statement for gender, body in self.bodies.items()}
        }

    def figure(self, clip: ReleaseClip) -> Figure:
        """The frames of a clip."""
        fingers = self.layout.num_joints > BODY_JOINTS
        palms = self.layout.name == "smpl75"
        frames = slice(clip.first, clip.last)
        label = clip.entry.file
        return read_motion(self.path_of(label), label, hands=fingers, palms=palms, frames=frames)

    def joints(self, clip: ReleaseClip) -> SourceJoints:
        return SourceJoints(self._posed(clip, self.figure(clip)), clip.fps)

    def convert(self, clip: ReleaseClip) -> Sample:
        figure = self.figure(clip)
        raw = self.layout.name == "smpl75"
        assert figure.rotations is not None
        # Resampling would take every 6th frame as it is (120 to 20 a second).
        ratio = clip.fps / self.layout.fps
        step = max(round(ratio), 1) if abs(ratio - round(ratio)) < 1e-6 else 1
        posed = self._posed(clip, figure)
        if raw:
            features = self._parameters(clip, figure, step)
        else:
            joints = posed[::step]
            if clip.entry.mirror_of is not None:
                joints = mirror(joints, self.layout.skeleton)
            features = features_of(joints, clip.fps / step, self.layout, same_bones=self.config.retarget)
        turned = np.ptp(figure.rotations[:, BODY_JOINTS:], axis=0)
        hands = not raw and float(turned.max(initial=0.0)) > FINGERS_MOVE
        meta = self.meta(
            clip, features, seen=SourceJoints(posed, clip.fps), source=clip.entry.file,
            licence=clip.licence, hands=hands, mirror_of=clip.entry.mirror_of,
        )  # fmt: skip
        return Sample(meta, features, texts=list(clip.entry.texts))

    def _body(self, clip: ReleaseClip) -> BodyModel:
        return self.bodies.get(str(clip.entry.facts["gender"])) or self.bodies["neutral"]

    def _parameters(self, clip: ReleaseClip, figure: Figure, step: int) -> NDArray[np.float32]:
        """Columns of `smpl75` [T', 75]."""
        assert figure.rotations is not None and figure.trans is not None
        body = self._body(clip)
        poses = figure.rotations[::step]
        trans = figure.trans[::step]
        if self.config.up == "z":
            poses, trans = upright(poses, trans, body)
        if clip.entry.mirror_of is not None:
            poses, trans = mirrored(poses, trans, body)
        require_human(smpl_joints(poses[:, :BODY_JOINTS], trans, body), clip.fps / step)
        return canonical_smpl75(poses, trans, body, clip.fps / step, self.layout.fps)

    def _posed(self, clip: ReleaseClip, figure: Figure) -> NDArray[np.float64]:
        """World joints [T, N, 3], Y up."""
        assert figure.rotations is not None and figure.trans is not None
        body = self._body(clip)
        count = self.layout.num_joints
        rotations = figure.rotations[:, : BODY_JOINTS if self.layout.name == "smpl75" else count]
        joints = smpl_joints(rotations, figure.trans, body, figure.betas)
        if self.config.up == "z":
            joints = joints[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
        return np.asarray(joints, dtype=np.float64)


def list_files(source: Path, draft: ConversionPlan[ReleaseClip]) -> list[str]:
    """Paths of the motion files in the source, in name order; names that cannot be ids go to `draft.broken`.

    Files that hold the shape of a subject without motion (`shape.npz`, `..._stagei.npz`) are none.
    """
    labels: list[str] = []
    for relative in walk_files(source):
        name = relative.rsplit("/", 1)[-1]
        if name.endswith(SUFFIX) and name != "shape.npz" and not name.endswith("_stagei.npz"):
            with draft.reading(relative):
                labels.append(check_id(relative, relative))
    if not labels:
        raise UserError(f"{source}: no {SUFFIX} file with motion in it")
    return labels


register(Amass)
