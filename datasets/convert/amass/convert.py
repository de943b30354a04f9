"""AMASS (SMPL-H or SMPL-X .npz) -> shards: parameters to joints without the mesh, joints to features.

Z up becomes Y up. Jaw, eyes, soft tissue (`dmpls`) and markers are not used. `smpl75` keeps the parameters,
without a shape; its two hand joints are SMPL's, at rest for SMPL-H and SMPL-X, which have none.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.amass.plan import LICENCE, AmassClip, AmassConfig, plan_amass
from motionloom.datasets.convert.amass.smpl_npz import SmplMotion, read_motion
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import (
    canonical_smpl75,
    features_of,
    mirrored,
    require_human,
    upright,
)
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.shards.sample import Sample

FINGERS_MOVE = 1e-3
"""Radians. Fingers that turn less than this over a clip were not captured, but set to one pose."""

_MODEL_OPTIONS = {"neutral": "body_model", "female": "body_model_female", "male": "body_model_male"}


class Amass(Converter[AmassConfig, AmassClip]):
    """The AMASS converter."""

    name = "amass"
    title = "AMASS"
    summary = "AMASS: SMPL-H and SMPL-X .npz files to shards."
    example = "AMASS shards"
    config_class = AmassConfig

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

    def plan(self, settings: PlanSettings) -> ConversionPlan[AmassClip]:
        plan = plan_amass(self.config, self.kinds, settings)
        plan.notes.extend(sorted({str(body.statement["sentence"]) for body in self.bodies.values()}))
        return plan

    def depends_on(self, clip: AmassClip) -> list[object]:
        texts = [caption.dump() for caption in clip.texts]
        return [clip.label(), clip.file.size, clip.first, clip.last, texts]

    def options(self) -> dict[str, object]:
        return super().options() | {
            "bodies": {gender: body.statement for gender, body in self.bodies.items()}
        }

    def joints(self, clip: AmassClip) -> SourceJoints:
        return SourceJoints(self._joints(clip, self._read(clip), 1), clip.fps)

    def convert(self, clip: AmassClip) -> Sample:
        motion = self._read(clip, palms=self.layout.name == "smpl75")
        # Resampling would take every 6th frame as it is (120 to 20 a second): pose no others.
        ratio = clip.fps / self.layout.fps
        step = max(round(ratio), 1) if abs(ratio - round(ratio)) < 1e-6 else 1
        if self.layout.name == "smpl75":
            features, turned = self._parameters(clip, motion, step), np.zeros(0)
        else:
            joints = self._joints(clip, motion, step)
            if clip.mirror_of is not None:
                joints = mirror(joints, self.layout.skeleton)
            features = features_of(joints, clip.fps / step, self.layout, same_bones=self.config.retarget)
            turned = np.ptp(motion.rotations[:, BODY_JOINTS:], axis=0)
        meta = self.meta(
            clip,
            features,
            source=clip.file.label,
            licence=self.config.licence or LICENCE,
            hands=bool(turned.size) and float(turned.max()) > FINGERS_MOVE,
            mirror_of=clip.mirror_of,
        )
        return Sample(meta, features, texts=list(clip.texts))

    def _parameters(self, clip: AmassClip, motion: SmplMotion, step: int) -> NDArray[np.float32]:
        """Columns of `smpl75` [T', 75]."""
        body = self.bodies.get(clip.header.gender) or self.bodies["neutral"]
        poses, trans = motion.rotations[::step], motion.trans[::step]
        if self.config.up == "z":
            poses, trans = upright(poses, trans, body)
        if clip.mirror_of is not None:
            poses, trans = mirrored(poses, trans, body)
        require_human(smpl_joints(poses[:, :BODY_JOINTS], trans, body), clip.fps / step)
        return canonical_smpl75(poses, trans, body, clip.fps / step, self.layout.fps)

    def _read(self, clip: AmassClip, palms: bool = False) -> SmplMotion:
        fingers = self.layout.num_joints > BODY_JOINTS
        frames = slice(clip.first, clip.last)
        return read_motion(clip.file.path, clip.file.label, hands=fingers, palms=palms, frames=frames)

    def _joints(self, clip: AmassClip, motion: SmplMotion, step: int) -> NDArray[np.float64]:
        """World joints [T, N, 3], Y up, of every `step`-th frame."""
        body = self.bodies.get(clip.header.gender) or self.bodies["neutral"]
        joints = smpl_joints(motion.rotations[::step], motion.trans[::step], body, motion.betas)
        if self.config.up == "z":
            joints = joints[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
        return np.asarray(joints, dtype=np.float64)
