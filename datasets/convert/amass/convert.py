"""AMASS (SMPL-H or SMPL-X .npz) -> shards: parameters to joints without the mesh, joints to features.

| in the file | in the sample |
|---|---|
| `poses` [T, 156 or 165], or `root_orient`, `pose_body`, `pose_hand` | `motion.npy` |
| `trans` | the path of the root in `motion.npy` |
| `betas`, `gender` | bone lengths, when a body model is given |
| `mocap_framerate` or `mocap_frame_rate` | resampled by time to `fps` |
| captions of your own, or HumanML3D's texts | `texts.json` |

Z up becomes Y up. Jaw, eyes, soft tissue (`dmpls`) and markers are not used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.convert.amass.plan import AmassClip, plan_amass
from motionloom.datasets.convert.amass.source import LICENCE, AmassConfig
from motionloom.datasets.convert.common.conversion import Conversion
from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.smpl_npz import SmplMotion, read_motion
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.motion.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.shards.sample import Sample

__all__ = ["AmassConfig", "prepare_amass"]

CONVERTER = "amass"
CONVERTER_VERSION = 1

FINGERS_MOVE = 1e-3
"""Radians. Fingers that turn less than this over a clip were not captured, but set to one pose."""

_PATHS = ("captions", "splits", "humanml_index", "humanml_texts")
_MODEL_PATHS = {
    "neutral": "body_model",
    "female": "body_model_female",
    "male": "body_model_male",
}
"""Options that hold local paths, beside the source."""


def prepare_amass(config: AmassConfig, *, workers: int = 1, progress: bool = False) -> Conversion[AmassClip]:
    """Plan the conversion of a folder of AMASS clips."""
    skeleton = cast("SkeletonName", config.motion_layout().skeleton_name)
    paths = {gender: getattr(config, option) for gender, option in _MODEL_PATHS.items()}
    bodies = {gender: BodyModel.load(path, skeleton) for gender, path in paths.items() if path is not None}
    kinds = {gender: str(body.statement["kind"]) for gender, body in bodies.items()}
    plan = plan_amass(config, kinds, workers=workers, progress=progress)
    bodies = bodies or {"neutral": BodyModel.neutral(skeleton)}
    statements = {gender: body.statement for gender, body in bodies.items()}
    plan.notes.extend(sorted({str(statement["sentence"]) for statement in statements.values()}))
    content = [
        [clip.label(), clip.file.size, clip.first, clip.last, [caption.dump() for caption in clip.texts]]
        for _, clip in plan.items
    ]
    options = config.options(*_PATHS, *_MODEL_PATHS.values())
    options |= {"humanml_index": config.humanml_index is not None, "bodies": statements}
    maker = ClipMaker(config, bodies)
    return Conversion(
        config=config,
        plan=plan,
        convert=maker,
        licence=config.licence or LICENCE,
        converter=CONVERTER,
        version=CONVERTER_VERSION,
        options=options | {"source_sha256": sha256_of_json(content)},
        see=maker.see,
        subset_of=lambda clip: clip.file.subset,
    )


@dataclass(frozen=True, eq=False)
class ClipMaker:
    """Everything a worker needs to make samples."""

    config: AmassConfig
    bodies: dict[str, BodyModel]
    """By gender; `neutral` serves the genders that are not there."""

    @cached_property
    def layout(self) -> MotionLayout:
        """The layout of the samples."""
        return self.config.motion_layout()

    def __call__(self, clip: AmassClip) -> Sample:
        """One sample; `UserError` when the motion cannot be used."""
        motion = self._read(clip)
        # Resampling would take every 6th frame as it is (120 to 20 a second): pose no others.
        ratio = clip.fps / self.layout.fps
        step = max(round(ratio), 1) if abs(ratio - round(ratio)) < 1e-6 else 1
        joints = self._joints(clip, motion, step)
        if clip.mirror_of is not None:
            joints = mirror(joints, self.layout.skeleton)
        features = features_of(joints, clip.fps / step, self.layout, same_bones=self.config.retarget)
        turned = np.ptp(motion.rotations[:, BODY_JOINTS:], axis=0)
        meta = self.layout.clip_meta(
            clip.id,
            source=clip.file.label,
            split=clip.split,
            frames=len(features),
            licence=self.config.licence or LICENCE,
            has_hands=bool(turned.size) and float(turned.max()) > FINGERS_MOVE,
            has_face=False,
            mirror_of=clip.mirror_of,
        )
        return Sample(meta, features, texts=list(clip.texts))

    def see(self, clip: AmassClip) -> SourceJoints:
        """The joints of one clip, Y up."""
        return SourceJoints(self._joints(clip, self._read(clip), 1), clip.fps)

    def _read(self, clip: AmassClip) -> SmplMotion:
        fingers = self.layout.num_joints > BODY_JOINTS
        frames = slice(clip.first, clip.last)
        return read_motion(clip.file.path, clip.file.label, hands=fingers, frames=frames)

    def _joints(self, clip: AmassClip, motion: SmplMotion, step: int) -> NDArray[np.float64]:
        """World joints [T, N, 3], Y up, of every `step`-th frame."""
        body = self.bodies.get(clip.header.gender) or self.bodies["neutral"]
        joints = smpl_joints(motion.rotations[::step], motion.trans[::step], body, motion.betas)
        if self.config.up == "z":
            joints = joints[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
        return np.asarray(joints, dtype=np.float64)
