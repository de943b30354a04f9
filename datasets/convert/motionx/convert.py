"""Motion-X -> shards: 322 SMPL-X columns at 30 fps to whole-body features with hands and face.

Choices, beside those of docs/sources.md:
- Joints come from the pose alone: forward kinematics on the user's body model with each clip's shape, or on a
  neutral skeleton, where shapes have no effect. Heading, floor and origin are made canonical for every clip,
  since video subsets lie about in their camera's world.
- The face is the 50 expression columns. Jaw and face shape are not features (HumanTOMATO section 4.2); layout
  `smplx322` keeps all columns.
- Nothing is invented: zero is what the sources of Motion-X hold where they know nothing (EgoBody's hands, for
  instance), so clips with nothing but zeros there have `has_face` or `has_hands` False.

Only the motion is required: splits, captions, face motion and face texts are taken where they are. A plan
reads headers and texts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.memory import content_of
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.features import features_of, require_human
from motionloom.datasets.convert.common.files import read_in_threads
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, Release, ReleaseClip, ReleaseConfig
from motionloom.datasets.convert.common.splits import original_of
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
from motionloom.datasets.convert.motionx.parameters import (
    BETAS,
    EXPRESSION,
    FACE_WIDTH,
    HANDS,
    RAW,
    TRANS,
    resample_parameters,
    scale_aist,
    value_limits,
    with_face,
)
from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.text.clean import emotion_of

FPS = 30.0
AIST = "aist"
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


class MotionXConfig(ReleaseConfig):
    """Options of the Motion-X converter. `source` is the folder that holds motion_data/ and texts/, under
    any of the names they have had."""

    layouts = ("wholebody363", "wholebody313", "body133", "tomato623", "h3d263", "smplx322")

    name: str = "motionx"
    layout: str = "wholebody363"
    """Feature layout of the shards; `smplx322` keeps all columns."""
    fps: float = FPS
    subsets: tuple[str, ...] = ()
    """Convert only these subsets (`GRAB`, `idea400`, ...); empty means all."""
    splits: Path | None = None
    """Folder of train.txt, val.txt, test.txt; else searched at the top of the source, in `split/`, `splits/`
    and `datasets/`; else 80/5/15 by hash of the id."""
    body_model: Path | None = None
    """Your SMPL-X or SMPL-H model (.npz), for joints with each clip's own shape; else a neutral skeleton."""
    uncaptioned: Literal["drop", "keep"] = "drop"


@dataclass(frozen=True)
class MotionXEntry(Entry):
    """A clip with what else Motion-X has of it."""

    face_texts: tuple[Caption, ...] = ()
    face: str | None = None
    """Face motion to write in."""


_Found = tuple[MotionXEntry, ConversionPlan[ReleaseClip]]
"""A clip; and what is said of its files."""


class MotionX(Release[MotionXConfig]):
    """The Motion-X converter."""

    name = "motionx"
    title = "Motion-X"
    summary = "Motion-X: SMPL-X parameters (322-d), body, hand and face texts to shards."
    example = "Motion-X shards"
    config_class = MotionXConfig
    terms = LICENCE
    lists = ("", "split", "splits", "datasets")

    def __init__(self, config: MotionXConfig) -> None:
        super().__init__(config)
        # Of smplx322 and layouts with fingers, the skeleton with fingers is posed.
        skeleton: SkeletonName = "smpl22" if self.layout.skeleton_name == "smpl22" else "smplx52"
        model = config.body_model  # a wrong one fails here
        self.body = BodyModel.load(model, skeleton) if model else BodyModel.neutral(skeleton)

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        config = self.config
        files = find_files(config.source)
        motion = files.by_kind["motion"]
        ids = sorted(clip_id for clip_id in motion if self._wanted(clip_id))
        if not ids:
            present = sorted({subset_of(clip_id) for clip_id in motion})
            raise UserError(f"{config.source}: none of {config.subsets} in it, but {', '.join(present)}")
        how = self.settings
        read = partial(self._entry, files)
        made: list[_Found] = list(read_in_threads(read, ids, workers=how.workers, progress=how.progress))
        entries = [entry for entry, _ in made]
        unwanted = len(motion) - len(ids)
        texts_alone = [clip_id for clip_id in files.by_kind["captions"] if clip_id not in motion]
        for one in files.repeated:
            draft.skip(one.source, one.reason)
        for one in files.broken:
            draft.mark_unreadable(one.source, UserError(one.reason))
        for _, said in made:
            draft.not_taken += said.not_taken
            draft.known.beside |= said.known.beside
        draft.notes += [
            *files.notes(),
            *([f"{unwanted} clips of other subsets are not asked for"] if unwanted else []),
            *([f"{len(texts_alone)} caption files have no motion"] if texts_alone else []),
            *(note for _, said in made for note in said.notes),
        ]
        return entries

    def _wanted(self, clip_id: str) -> bool:
        return not self.config.subsets or subset_of(clip_id) in self.config.subsets

    def split_lists(self, draft: ConversionPlan[ReleaseClip]) -> dict[str, Split] | None:
        listed = super().split_lists(draft)
        if listed is None:
            return None
        splits: dict[str, Split] = {}
        for clip_id, split in listed.items():
            official = official_id(clip_id)
            if splits.setdefault(official, split) != split:
                raise UserError(f"'{official}' is in {splits[official]}.txt and {split}.txt; that leaks")
        return {key: split for key, split in splits.items() if self._wanted(key)}

    def _entry(self, files: MotionXFiles, clip_id: str) -> _Found:
        """A clip with its texts. Segments of humanml's captions are checked when its length is known."""
        source = self.config.source
        said = ConversionPlan[ReleaseClip](self.config)

        def read(kind: Kind, reader: Callable[..., tuple[list[Caption], list[str]]]) -> tuple[Caption, ...]:
            file = files.by_kind[kind].get(clip_id)
            texts = list[Caption]()
            if file is not None:
                with said.reading(file):
                    texts, wrong = reader(source / file, name=file)
                    said.notes += [f"{file}: {'; '.join(wrong)}"] if wrong else []
            return tuple(texts)

        in_grammar = subset_of(clip_id) == HUMANML
        captions = partial(read_humanml_captions, seconds=None) if in_grammar else read_sentences
        face = None
        stored = files.by_kind["face motion"].get(clip_id)
        if stored is not None:
            with said.reading(stored):
                check_array_header(source / stored, width=FACE_WIDTH, name=stored)
                face = stored
        subset = subset_of(clip_id)
        entry = MotionXEntry(
            clip_id, files.by_kind["motion"][clip_id],
            read("captions", partial(captions, source=SOURCE)),
            group=original_of(clip_id) or clip_id, facts={"subset": subset},
            mirror_of=original_of(clip_id), licence=LICENCES.get(subset, LICENCE),
            face_texts=read("face texts", partial(read_sentences, source="face")),
            face=face,
        )  # fmt: skip
        return entry, said

    def length(self, path: Path, label: str) -> tuple[int, float]:
        return check_array_header(path, width=RAW.dim, name=label), FPS

    def path_of(self, file: str) -> Path:
        return self.config.source / file  # `find_files` has looked where links lead

    def depends_on(self, clip: ReleaseClip) -> list[object]:
        entry = _with_face(clip)
        files = [entry.file, *([entry.face] if entry.face else [])]
        contents = [content_of(self.path_of(file)) for file in files]
        texts = [caption.dump() for caption in (*entry.texts, *entry.face_texts)]
        return [clip.id, files, contents, clip.licence, texts]

    def options(self) -> dict[str, object]:
        return super().options() | {"body_model": self.body.statement}

    def figure(self, clip: ReleaseClip) -> Figure:
        return Figure(joints=parameters_to_joints(self.parameters(clip), self.body))

    def convert(self, clip: ReleaseClip) -> Sample:
        config = self.config
        layout = self.layout
        entry = _with_face(clip)
        values = self.parameters(clip)
        has_face = bool(values[:, EXPRESSION].any())
        joints = parameters_to_joints(values, self.body)
        if layout.family == "raw":
            require_human(joints, FPS)
            motion = resample_parameters(values, FPS, layout.fps).astype(np.float32)
        else:
            face = values[:, EXPRESSION] if layout.has("face") and has_face else None
            motion = features_of(joints, FPS, layout, face=face, same_bones=config.retarget)
        meta = self.clip_meta(
            clip,
            motion,
            joints,
            hands=layout.num_joints > BODY_JOINTS and bool(values[:, HANDS].any()),
            face=layout.has("face") and has_face,
        )
        faces = list(entry.face_texts)
        # A clip with a face but no words about it takes the emotion that its captions name.
        emotion = None if faces or not meta.has_face else emotion_of(caption.text for caption in entry.texts)
        if emotion is not None:
            faces = [Caption(text=emotion, source="emotion")]
        return Sample(meta=meta, motion=motion, texts=list(entry.texts), face_texts=faces)

    def parameters(self, clip: ReleaseClip) -> NDArray[np.float64]:
        """The clip's columns [T, 322], repaired: metres, face motion written in."""
        entry = _with_face(clip)
        subset = subset_of(clip.id)
        path = self.path_of(entry.file)
        limits = value_limits()
        values = load_array(path, width=RAW.dim, name=entry.file, limit=limits).astype(np.float64)
        if len(values) != clip.last:
            raise UserError(
                f"{entry.file}: {len(values)} frames, {clip.last} when the plan was made; convert again"
            )
        if subset == AIST:
            values = scale_aist(values)
        if entry.face is not None:
            face = load_array(self.path_of(entry.face), width=FACE_WIDTH, name=entry.face, limit=1000.0)
            values = with_face(values, face, keep_jaw=subset == "GRAB")
        return values


def _with_face(clip: ReleaseClip) -> MotionXEntry:
    assert isinstance(clip.entry, MotionXEntry)
    return clip.entry


def parameters_to_joints(values: NDArray[np.float64], body: BodyModel) -> NDArray[np.float64]:
    """Columns [T, 322] -> joints [T, N, 3] in metres, of as many joints as the body's skeleton has."""
    count = len(body.skeleton)
    rotations = values[:, : 3 * count].reshape(len(values), count, 3)
    # The shape is one a clip; where a fit let it waver, the median is that of most frames.
    return smpl_joints(rotations, values[:, TRANS], body, np.median(values[:, BETAS], axis=0))


register(MotionX)
