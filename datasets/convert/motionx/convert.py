"""Motion-X -> shards: 322 SMPL-X columns at 30 fps to whole-body features with hands and face.

Choices, beside those of docs/sources.md:
- Joints come from the pose alone: forward kinematics on the user's body model with each clip's shape, or on a
  neutral skeleton, where shapes have no effect. Heading, floor and origin are made canonical for every clip,
  since video subsets lie about in their camera's world.
- The face is the 50 expression columns. Jaw and face shape are not features (HumanTOMATO section 4.2); layout
  `smplx322` keeps all columns.
- Nothing is invented: zero is what the sources of Motion-X hold where they know nothing (EgoBody's hands, for
  instance), so clips with nothing but zeros there have `has_face` or `has_hands` False.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.arrays import load_array
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import body_of, features_of, require_human
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.splits import original_of
from motionloom.datasets.convert.motionx.files import read_frame_texts
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
    z_up_to_y_up,
)
from motionloom.datasets.convert.motionx.plan import (
    AIST,
    FPS,
    LICENCE,
    MotionXClip,
    MotionXConfig,
    plan_motionx,
)
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.schema import Caption, UserError
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.text.clean import emotion_of


class MotionX(Converter[MotionXConfig, MotionXClip]):
    """The Motion-X converter."""

    name = "motionx"
    title = "Motion-X"
    summary = "Motion-X: SMPL-X parameters (322-d), body, hand and face texts to shards."
    example = "Motion-X shards"
    config_class = MotionXConfig

    def __init__(self, config: MotionXConfig) -> None:
        super().__init__(config)
        self.body = body_of(config.body_model, config.skeleton)  # a wrong one fails here

    def plan(self, settings: PlanSettings) -> ConversionPlan[MotionXClip]:
        return plan_motionx(self.config, settings)

    def depends_on(self, clip: MotionXClip) -> list[object]:
        sizes = [(self.config.source / file).stat().st_size for file in clip.files]
        texts = [caption.dump() for caption in (*clip.texts, *clip.face_texts)]
        return [clip.id, clip.files, sizes, clip.licence, texts]

    def options(self) -> dict[str, object]:
        return super().options() | {"body_model": self.body.statement}

    def licence(self, plan: ConversionPlan[MotionXClip]) -> str:
        return self.config.licence or (next(iter(plan.licences)) if len(plan.licences) == 1 else LICENCE)

    def subset(self, clip: MotionXClip) -> str:
        return clip.subset

    def joints(self, clip: MotionXClip) -> SourceJoints:
        return SourceJoints(parameters_to_joints(read_parameters(self.config, clip), self.body), FPS)

    def convert(self, clip: MotionXClip) -> Sample:
        config, layout = self.config, self.layout
        values = read_parameters(config, clip)
        has_face = bool(values[:, EXPRESSION].any())
        joints = parameters_to_joints(values, self.body)
        if layout.family == "raw":
            require_human(joints, FPS)
            motion = resample_parameters(values, FPS, layout.fps).astype(np.float32)
        else:
            face = values[:, EXPRESSION] if layout.has("face") and has_face else None
            motion = features_of(joints, FPS, layout, face=face, same_bones=config.retarget)
        meta = self.meta(
            clip,
            motion,
            licence=clip.licence,
            hands=layout.num_joints > BODY_JOINTS and bool(values[:, HANDS].any()),
            face=layout.has("face") and has_face,
            mirror_of=original_of(clip.id),
        )
        texts = [*clip.texts, *_frame_captions(config, clip)]
        faces = list(clip.face_texts)
        emotion = None if faces or not meta.has_face else emotion_of(caption.text for caption in clip.texts)
        if emotion is not None:
            faces = [Caption(text=emotion, source="emotion")]
        return Sample(meta=meta, motion=motion, texts=texts, face_texts=faces)


def read_parameters(config: MotionXConfig, clip: MotionXClip) -> NDArray[np.float64]:
    """The clip's columns [T, 322], repaired: metres, Y up, face motion written in."""
    raw = load_array(config.source / clip.path, width=RAW.dim, name=clip.path, limit=value_limits())
    if len(raw) != clip.frames:
        raise UserError(
            f"{clip.path}: {len(raw)} frames, {clip.frames} when the plan was made; convert again"
        )
    values = raw.astype(np.float64)
    if clip.subset == AIST:
        values = scale_aist(values)
    if config.up == "z":
        values = z_up_to_y_up(values)
    if clip.face is not None:
        face = load_array(config.source / clip.face, width=FACE_WIDTH, name=clip.face, limit=1000.0)
        values = with_face(values, face, keep_jaw=clip.subset == "GRAB")
    return values


def parameters_to_joints(values: NDArray[np.float64], body: BodyModel) -> NDArray[np.float64]:
    """Columns [T, 322] -> joints [T, N, 3] in metres, of as many joints as the body's skeleton has."""
    count = len(body.skeleton)
    rotations = values[:, : 3 * count].reshape(len(values), count, 3)
    # The shape is one a clip; where a fit let it waver, the median is that of most frames.
    return smpl_joints(rotations, values[:, TRANS], body, np.median(values[:, BETAS], axis=0))


def _frame_captions(config: MotionXConfig, clip: MotionXClip) -> list[Caption]:
    return [
        caption
        for source, file in clip.frame_texts
        for caption in read_frame_texts(
            config.source / file, source=source, frames=clip.frames, fps=FPS, name=file
        )
    ]
